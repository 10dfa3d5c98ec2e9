"use strict";
// The page of the cockpit. It shows what the server answers, and knows no rule of the world.
// A moment is one entry of flight.moments: pose, reward, return, d_obs, q, and a picture.

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const PIXELS = 84;

let options; // what one may choose from
let chosen = {}; // world, weights, seed, pilot: what is chosen
let flight = null; // the flight on show: {moments, trunks, actions, ended, record}
let ghost = null; // another flight through the same forest: the same, and a label
let t = 0; // the moment on show
let reasons = null; // the answer to "why", of moment t
let removed = null; // the entry of reasons.without that is looked at
let playing = false;
let busy = false; // a step is on its way
let generation = 0; // of the flight on show: answers that come for an older one are dropped
let loops = 0; // of the player: a pause ends its loop, even if a new one begins at once
const landed = []; // flights that were flown by hand to their end, to save
const stick = { held: {}, tapped: {}, side: 0, level: 0 };

// -------------------------------------------------- the server

async function post(path, content) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(content) });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer.json();
}

function ask(path, more) {
  const { world, weights, seed } = chosen;
  return post(path, { world, weights, seed, ...more });
}

function fly(actions, pilot, more, since, pictures = true) {
  const counts = { more: String(more), since: String(since), pictures: pictures ? "1" : "0" };
  return ask("/fly", { actions, pilot: pilot === "you" ? "network" : pilot, ...counts });
}

// A newer flight makes an older question pointless. Whatever else fails is told in one line.
async function attempt(action) {
  const mine = generation;
  try {
    return await action();
  } catch (error) {
    pause();
    const lost = error instanceof TypeError ? "The server does not answer. Is it still running?" : error.message;
    if (mine === generation) say(lost);
  }
}

// -------------------------------------------------- flights

const world = () => options.worlds[chosen.world];
const end = () => flight.moments.length - 1;
const over = () => flight.ended !== "";
const straight = () => (world().actions - 1) / 2;
const mine = () => chosen.pilot === "you";

function add(to, answer) {
  to.moments.push(...answer.moments);
  to.record = answer.flight;
  to.actions = answer.flight.actions;
  to.ended = answer.ended;
}

async function begin(actions = "", moment = 0) {
  const me = ++generation;
  pause();
  const answer = await fly(actions, "you", 0, 0);
  if (me !== generation) return;
  [flight, ghost] = [{ moments: [], trunks: answer.trunks }, null];
  add(flight, answer);
  drawForest();
  show(Math.min(moment, end()));
  if (mine() && !actions) say("Press ← or → to take off. Hold to turn harder. The network flies along as a ghost.");
  while (!mine() && !over()) {
    const more = await fly(flight.actions, chosen.pilot, 25, flight.moments.length);
    if (me !== generation) return;
    add(flight, more);
    show(t);
  }
  if (chosen.pilot === "network") return;
  const other = await fly("", "network", world().max_steps, 0, false);
  if (me !== generation || ghost) return;
  ghost = { label: "the network", moments: [] };
  add(ghost, other);
  show(t);
}

async function steer() {
  if (busy) return;
  busy = true;
  const [me, start] = [generation, performance.now()];
  const answer = await fly(flight.actions + turn(), "you", 0, flight.moments.length).finally(() => (busy = false));
  if (me !== generation) return;
  add(flight, answer);
  show(end());
  performance.measure("step to picture", { start });
  if (!over()) return;
  landed.push({ world: chosen.world, ...flight.record });
  pause();
  say("R: fly this forest again. N: the next one. Or drag the time line back, and ask why the network would turn.");
}

function turn() {
  const on = (side) => stick.held[side] || stick.tapped[side] || 0;
  const side = on("left") - on("right");
  stick.level = side && side === stick.side ? Math.min(stick.level + 1, straight()) : Math.abs(side);
  [stick.side, stick.tapped] = [side, {}];
  return straight() + side * stick.level;
}

function hold(side, down) {
  stick.held[side] = down ? 1 : 0;
  if (!down) return;
  if (!mine()) return say("Choose the pilot You, or Take over here, to steer.");
  stick.tapped[side] = 1;
  if (t === end() && !over()) play();
}

async function whatIf(action) {
  pause();
  const [me, from] = [generation, t];
  const turns = Number($("hold").value);
  const way = flight.actions.slice(0, from);
  // The turn may end the flight by itself, so it is flown step by step.
  let answer = await fly(way, "network", 0, from, false);
  const other = { label: `what if ${rate(action)} at ${clock(from)}`, moments: flight.moments.slice(0, from) };
  add(other, answer);
  for (let i = 0; i < turns && !other.ended; i++) {
    add(other, await fly(other.actions + action, "network", 0, other.moments.length, false));
  }
  add(other, await fly(other.actions, "network", world().max_steps, other.moments.length, false));
  if (me !== generation) return;
  ghost = other;
  show(from);
  say(`With ${rate(action)} rad/s from here: ${other.ended}, total reward ${number(other.record.return)}. The flight on show: ${flight.ended || "still flies"}, ${number(flight.record.return)}.`);
}

function takeOver() {
  chosen.pilot = "you";
  const way = flight.actions.slice(0, t);
  drawChoices();
  attempt(() => begin(way, t)).then(() => say("You have the controls. Press ← or → to fly on, or space to go straight."));
}

// The greatest Q is what the network expects from here on. Where it falls most, it was surprised.
function wentWrong() {
  pause();
  const best = flight.moments.map((m) => Math.max(...m.q));
  let worst = 0;
  for (let i = 1; i < end() - 1; i++) {
    if (best[i] - best[i + 1] > best[worst] - best[worst + 1]) worst = i;
  }
  if (end() < 2) return say("Nothing has been flown yet.");
  show(worst);
  say(`At ${clock(worst)} the greatest Q falls most, from ${number(best[worst])} to ${number(best[worst + 1])}. Step on with . and see.`);
}

// -------------------------------------------------- why

async function why(trunk = null) {
  pause();
  const [me, at] = [generation, t];
  const answer = reasons || (await ask("/why", { actions: flight.actions, time: String(at) }));
  if (me !== generation || at !== t) return;
  reasons = answer;
  removed = reasons.without.find((x) => x.trunk === trunk) || null;
  if (trunk !== null && !removed) say("That trunk is in none of the four pictures. Without it nothing would change.");
  draw();
  tellWhy();
}

function tellWhy() {
  const strongest = [...reasons.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight));
  const text = document.createElement("p");
  text.innerHTML = `It would turn <b>${rate(reasons.chosen)} rad/s</b>. How much of that turn's lead over the mean
    Q hangs on each thing in view: <span class="for">for</span> it, <span class="against">against</span> it.`;
  const row = document.createElement("div");
  row.className = "row";
  for (const x of strongest.slice(0, 8)) {
    const name = x.trunk < 0 ? "the goal's pole" : `trunk ${whereabouts(flight.trunks[x.trunk])}`;
    const button = addButton(row, `${name} ${signed(x.weight)}`, () => why(x === removed ? null : x.trunk));
    button.classList.add(x.weight > 0 ? "for" : "against");
    button.setAttribute("aria-pressed", x === removed);
    button.title = "Take it out of this decision";
  }
  if (!strongest.length) text.textContent = "Nothing is in view.";
  $("answer").replaceChildren(text, row);
}

function whereabouts([x, y]) {
  const [px, py, heading] = flight.moments[t].pose;
  const [dx, dy] = [x - px, y - py];
  const left = dy * Math.cos(heading) - dx * Math.sin(heading);
  return `${Math.hypot(dx, dy).toFixed(0)} m off, ${Math.abs(left).toFixed(1)} m ${left > 0 ? "left" : "right"}`;
}

function clickMap(event) {
  const place = new DOMPoint(event.clientX, event.clientY).matrixTransform($("map").getScreenCTM().inverse());
  const far = ([x, y]) => Math.hypot(x - place.x, -y - place.y);
  const nearest = flight.trunks.reduce((best, trunk, i) => (far(trunk) < far(flight.trunks[best]) ? i : best), 0);
  const pole = far([world().length, 0]);
  if (world().beacon && pole < Math.min(3, far(flight.trunks[nearest]))) return attempt(() => why(-1));
  if (far(flight.trunks[nearest]) < 2.5) attempt(() => why(nearest));
}

// -------------------------------------------------- play

function play() {
  if (playing) return;
  playing = true;
  $("play").textContent = "Pause";
  attempt(loop);
}

function pause() {
  playing = false;
  $("play").textContent = "Play";
  remember();
}

async function loop() {
  const me = ++loops;
  let due = performance.now();
  if (t === end() && over()) show(0);
  while (playing && me === loops) {
    if (t < end()) show(t + 1);
    else if (over()) pause();
    else if (mine()) await steer();
    due = Math.max(due + (1000 * world().dt) / Number($("speed").value), performance.now());
    await new Promise((wake) => setTimeout(wake, due - performance.now()));
  }
}

function stepOn() {
  pause();
  if (t < end()) show(t + 1);
  else if (mine() && !over()) attempt(steer);
}

function show(moment) {
  if (moment !== t || !reasons) {
    [reasons, removed] = [null, null];
    $("answer").replaceChildren();
  }
  t = moment;
  draw();
  if (!playing) remember();
}

// -------------------------------------------------- drawing

const number = (x) => x.toFixed(1);
const signed = (x) => (x < 0 ? "−" : "+") + Math.abs(x).toFixed(1);
const clock = (moment) => `${(moment * world().dt).toFixed(1)} s`;

function rate(action) {
  const x = world().yaw_rate * (action / straight() - 1);
  return x === 0 ? "0" : (x < 0 ? "−" : "+") + Math.abs(x).toFixed(2).replace("0.", ".");
}

function say(text) {
  $("hint").textContent = text;
}

function drawForest() {
  const { length, width, back, trunk_radius, goal_radius, actions } = world();
  const set = (id, values) => Object.entries(values).forEach(([key, x]) => $(id).setAttribute(key, x));
  set("map", { viewBox: `-4 ${-width / 2 - 2} ${length + 8} ${width + 4}` });
  set("ground", { x: -back, y: -width / 2, width: length + back, height: width });
  set("goal", { cx: length, cy: 0, r: goal_radius });
  $("trunks").replaceChildren(...flight.trunks.map(([x, y]) => {
    const circle = document.createElementNS(SVG, "circle");
    Object.entries({ cx: x, cy: -y, r: trunk_radius }).forEach(([key, value]) => circle.setAttribute(key, value));
    return circle;
  }));
  if ($("bars").children.length === actions) return;
  $("bars").replaceChildren();
  for (let a = actions - 1; a >= 0; a--) {
    const bar = addButton($("bars"), "", () => attempt(() => whatIf(a)));
    bar.innerHTML = `<span class="value"></span><span class="well"><i></i><i class="other"></i></span><span class="rate">${rate(a)}</span><span class="after"></span>`;
  }
}

function draw() {
  drawPictures();
  drawMap();
  drawBars();
  drawCurves();
  drawTable();
  $("time").max = end();
  $("time").value = t;
  $("time").setAttribute("aria-valuetext", clock(t));
  $("clock").textContent = `${clock(t)} / ${clock(end())}`;
  $("banner").textContent = banner();
}

function banner() {
  if (removed) return removed.trunk < 0 ? "without the goal's pole" : "without this trunk";
  if (t === end() && over()) return `${flight.ended}, total reward ${number(flight.record.return)}`;
  return mine() && end() === 0 ? "← or → to take off" : "";
}

function paint(canvas, frame) {
  const grey = atob(frame);
  const image = new ImageData(PIXELS, PIXELS);
  for (let i = 0; i < grey.length; i++) image.data.fill(grey.charCodeAt(i), 4 * i, 4 * i + 3);
  for (let i = 3; i < image.data.length; i += 4) image.data[i] = 255;
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function drawPictures() {
  paint($("seen"), removed ? removed.frame : flight.moments[t].frame);
  [...$("stack").children].forEach((canvas, i) => paint(canvas, flight.moments[Math.max(t - 3 + i, 0)].frame));
}

function way(moments) {
  return moments.map(({ pose: [x, y] }) => `${x.toFixed(2)},${(-y).toFixed(2)}`).join(" ");
}

function drawMap() {
  const [x, y, heading] = flight.moments[t].pose;
  const place = `translate(${x} ${-y}) rotate(${(-heading * 180) / Math.PI})`;
  const { view } = world();
  const edge = view * Math.tan(options.half_view);
  $("drone").setAttribute("transform", place);
  $("view").setAttribute("transform", place);
  $("view").setAttribute("d", `M0 0L${view} ${edge}V${-edge}Z`);
  $("whole-way").setAttribute("points", way(flight.moments));
  $("way").setAttribute("points", way(flight.moments.slice(0, t + 1)));
  // Who flies by hand should not see where the ghost is going to turn.
  const shown = !ghost ? [] : mine() && !over() && !ghost.label.startsWith("what") ? ghost.moments.slice(0, t + 1) : ghost.moments;
  $("ghost-way").setAttribute("points", way(shown));
  $("ghost").style.display = ghost ? "" : "none";
  const at = ghost ? ghost.moments[Math.min(t, ghost.moments.length - 1)].pose : [0, 0];
  $("ghost").setAttribute("cx", at[0]);
  $("ghost").setAttribute("cy", -at[1]);
  $("main-name").textContent = mine() ? "you" : chosen.pilot;
  $("ghost-name").textContent = ghost ? ghost.label : "(no second flight)";
  paintTrunks();
}

function paintTrunks() {
  const most = Math.max(...(reasons ? reasons.without : []).map((x) => Math.abs(x.weight)), 1e-9);
  const known = new Map((reasons ? reasons.without : []).map((x) => [x.trunk, x]));
  [...$("trunks").children].forEach((circle, i) => {
    const x = known.get(i);
    const share = x ? Math.abs(x.weight) / most : 0;
    circle.setAttribute("class", !x ? "" : x === removed ? "removed" : x.weight > 0 ? "for" : "against");
    circle.style.fillOpacity = x ? 0.35 + 0.65 * share : "";
    circle.setAttribute("r", world().trunk_radius * (x ? 1.2 + share : 1));
  });
}

function drawBars() {
  const q = flight.moments[t].q;
  const other = removed ? removed.q : null;
  const all = [...q, ...(other || [])];
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const height = (x) => `${(100 * (x - low)) / Math.max(high - low, 1e-9)}%`;
  [...$("bars").children].forEach((bar, i) => {
    const a = q.length - 1 - i;
    const [value, well, , after] = bar.children;
    value.textContent = number(q[a]);
    after.textContent = other ? number(other[a]) : "";
    well.children[0].style.height = height(q[a]);
    well.children[1].style.height = other ? height(other[a]) : "";
    well.children[1].hidden = !other;
    bar.className = (q[a] === Math.max(...q) ? "best " : "") + (Number(flight.actions[t]) === a ? "flown" : "");
    bar.setAttribute("aria-label", `what if ${rate(a)} radians a second? Q ${number(q[a])}${other ? `, without it ${number(other[a])}` : ""}`);
  });
}

const CURVES = { reward: "reward", return: "total reward", d_obs: "nearest bark, m" };

function drawCurves() {
  Object.keys(CURVES).forEach((key, i) => {
    const [label, svg] = $("curves").children[i].children;
    const values = flight.moments.map((m) => m[key]);
    const [low, high] = [Math.min(0, ...values), Math.max(1, ...values)];
    const [across, up] = [(k) => (100 * k) / Math.max(end(), 1), (x) => 30 - (30 * (x - low)) / (high - low)];
    svg.children[0].setAttribute("d", "M" + values.map((x, k) => `${across(k).toFixed(2)} ${up(x).toFixed(2)}`).join("L"));
    svg.children[1].setAttribute("d", `M${across(t)} 0V30`);
    label.lastChild.textContent = number(values[t]);
  });
}

function drawTable() {
  const flights = [[mine() ? "you" : chosen.pilot, flight], ...(ghost ? [[ghost.label, ghost]] : [])];
  const hidden = mine() && !over();
  const yes = (x) => (x ? "yes" : "no");
  const rows = {
    steps: (x) => x.steps,
    crossed: (x) => yes(x.outcome === "goal" || x.edge === "far"),
    crashed: (x) => yes(x.outcome === "crash"),
    arrived: (x) => yes(x.outcome === "goal"),
    "total reward": (x) => number(x.return),
  };
  const cells = (row) => flights.map(([, f]) => `<td>${f.ended && !(hidden && f === ghost) ? row(f.record) : "…"}</td>`).join("");
  $("table").innerHTML = `<tr><th></th>${flights.map(([name]) => `<th scope="col">${name}</th>`).join("")}</tr>` +
    Object.entries(rows).map(([name, row]) => `<tr><th scope="row">${name}</th>${cells(row)}</tr>`).join("");
}

// -------------------------------------------------- choices, address, file

function addButton(parent, text, action) {
  const button = parent.appendChild(document.createElement("button"));
  button.textContent = text;
  button.addEventListener("click", action);
  return button;
}

function choose(change, actions = "", moment = 0) {
  chosen = { ...chosen, ...change };
  if (!world().weights.includes(chosen.weights)) chosen.weights = world().weights[0];
  drawChoices();
  return attempt(() => begin(actions, moment));
}

function drawChoices() {
  const names = { pilot: options.pilots, world: Object.keys(options.worlds) };
  for (const [key, all] of Object.entries(names)) {
    const row = $(`${key}s`);
    if (!row.children.length) all.forEach((name) => addButton(row, name, () => choose({ [key]: name })));
    [...row.children].forEach((button) => button.setAttribute("aria-pressed", button.textContent === chosen[key]));
  }
  $("weights").replaceChildren(...world().weights.map((name) => new Option(name, name, false, name === chosen.weights)));
  $("seed").value = chosen.seed;
}

function address() {
  const { world, weights, pilot, seed } = chosen;
  return "#" + new URLSearchParams({ world, weights, pilot, seed, t, actions: flight.actions });
}

// Browsers complain if the address changes more than some times a second.
let later = 0;
function remember() {
  clearTimeout(later);
  later = setTimeout(() => flight && history.replaceState(null, "", address()), 150);
}

function restore() {
  const told = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const first = Object.keys(options.worlds)[0];
  chosen = { pilot: "you", world: first, seed: "1", weights: "" };
  const change = {};
  if (options.pilots.includes(told.pilot)) change.pilot = told.pilot;
  if (told.world in options.worlds) change.world = told.world;
  if (told.seed) change.seed = told.seed;
  const known = options.worlds[change.world || first].weights;
  if (told.weights && !known.includes(told.weights)) say(`There are no weights ${told.weights} here.`);
  choose({ ...change, weights: told.weights }, told.actions || "", Number(told.t) || 0);
}

async function share() {
  history.replaceState(null, "", address());
  await navigator.clipboard.writeText(location.href).catch(() => null);
  say("The address of this page holds this flight at this moment. It is copied: paste it anywhere.");
}

function save() {
  const flights = landed.filter((f) => f.world === chosen.world && f.seed < options.train_end);
  if (!flights.length) return say("Fly to an end first, in a forest below 1,000,000,000: others are for tests.");
  const { beacon, camera } = world();
  const report = { program: "Deep Flight", weights: chosen.weights, beacon, camera, first_seed: flights[0].seed };
  report.pilots = { you: { flights: flights.map(({ world, ...f }) => f) } };
  report.forests = flights.length;
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(report)], { type: "application/json" }));
  link.download = "flights.json";
  link.click();
  const flags = (beacon ? " --beacon" : "") + (camera === "grey" ? "" : ` --camera ${camera}`);
  say(`${flights.length} of your flights saved. To teach with them: deepflight.py train --demos flights.json${flags}`);
}

// -------------------------------------------------- keys and buttons

const next = () => choose({ seed: String(BigInt(chosen.seed) + 1n) });
const again = () => choose({});
const KEYS = {
  " ": () => (playing ? pause() : play()),
  ",": () => (pause(), show(Math.max(t - 1, 0))),
  ".": stepOn, n: next, r: again,
};
const SIDES = { ArrowLeft: "left", a: "left", ArrowRight: "right", d: "right" };

function key(event) {
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const typing = event.target.matches("input, select") || (name === " " && event.target.matches("button"));
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !flight) return;
  const side = SIDES[name];
  if (!side && !KEYS[name]) return;
  event.preventDefault();
  if (side && !event.repeat) hold(side, true);
  if (!side) KEYS[name]();
}

function listen() {
  const on = (id, event, action) => $(id).addEventListener(event, action);
  document.addEventListener("keydown", key);
  document.addEventListener("keyup", (event) => hold(SIDES[event.key.length === 1 ? event.key.toLowerCase() : event.key], false));
  window.addEventListener("blur", () => (stick.held = {}));
  window.addEventListener("hashchange", restore);
  document.addEventListener("visibilitychange", () => document.hidden && flight && pause());
  // A button that was clicked by a mouse would keep the focus, and take the space key.
  document.addEventListener("click", (event) => event.detail && document.activeElement.matches("button") && document.activeElement.blur());
  for (const side of ["left", "right"]) {
    on(side, "pointerdown", () => hold(side, true));
    ["pointerup", "pointerleave", "pointercancel"].forEach((name) => on(side, name, () => hold(side, false)));
  }
  const clicks = { next, share, save, wrong: wentWrong, take: takeOver, play: KEYS[" "], back: KEYS[","], step: stepOn };
  for (const [id, action] of Object.entries(clicks)) on(id, "click", () => flight && action());
  on("why", "click", () => attempt(() => why()));
  on("random", "click", () => choose({ seed: String(Math.floor(Math.random() * options.train_end)) }));
  on("map", "click", clickMap);
  on("time", "input", () => (pause(), show(Number($("time").value))));
  on("time", "pointerup", () => $("time").blur());
  on("seed", "change", () => ($("seed").blur(), choose({ seed: $("seed").value.trim() })));
  on("weights", "change", () => ($("weights").blur(), choose({ weights: $("weights").value })));
  for (const id of ["hold", "speed"]) on(id, "change", () => $(id).blur());
}

async function start() {
  for (let i = 0; i < 4; i++) {
    const canvas = $("stack").appendChild(document.createElement("canvas"));
    canvas.width = canvas.height = PIXELS;
  }
  for (const label of Object.values(CURVES)) {
    const row = $("curves").appendChild(document.createElement("div"));
    row.className = "curve";
    row.innerHTML = `<span>${label} <b></b></span><svg viewBox="0 0 100 30" preserveAspectRatio="none" aria-hidden="true"><path/><path class="cursor"/></svg>`;
  }
  options = await post("/options", {});
  listen();
  restore();
}

attempt(start);
