"use strict";
// The page of the cockpit. It shows what the server answers, and knows no rule of the world.
// An episode has moments; each has pose, reward, return, d_obs, q, and a frame.

const $ = (id) => document.getElementById(id);
const PIXELS = 84;
const ENDS = {
  crash: "crashed into a trunk", goal: "arrived at the goal", far: "crossed: left by the far edge",
  side: "left by a side", back: "left by the back", time: "out of time",
};
const MEANING = { beacon: "A pole stands at the goal, and can be seen.", disparity: "The frames show how near things are." };
let options; // what one may choose from, and the numbers of each world
let chosen = {}; // world, weights, seed, pilot
let episode = null; // the episode on show: choice, moments, record, actions, trunks
let [ghost, plain] = [null, null]; // another one through the same forest, and its label; the one to go back to
let t = 0; // the moment on show
let [reasons, removed] = [null, null]; // the answer to "why" of moment t; what is taken out on show
let [playing, underway] = [false, null]; // underway: the promise of a step that the server has not answered
let [generation, asked] = [0, 0]; // of episodes, and of what was asked: what an older one waited for is dropped
const done = new Map(JSON.parse(sessionStorage.done || "[]")); // flown by hand to their end, each once
const stick = { held: {}, tapped: {}, side: 0, level: 0 };

const world = () => options.worlds[chosen.world];
const end = () => episode.moments.length - 1;
const over = () => episode.record.outcome !== "";
const ended = ({ record: { outcome } }) => ENDS[outcome];
const isQ = () => world().weights[chosen.weights] === "dqn"; // an imitated network scores, and knows no return
const score = () => (isQ() ? "Q" : "score");
const byHand = () => chosen.pilot === "you";
const steers = () => byHand() && t === end() && !over();
const straight = () => (world().num_actions - 1) / 2;
const number = (x) => (Math.round(10 * x) / 10 || 0).toFixed(1).replace("-", "−"); // never −0.0
const clock = (moment) => `${(moment * world().dt).toFixed(1)} s`;
const signed = (x) => (x < 0 ? "−" : "+") + Math.abs(x).toFixed(2).replace(/^0/, "");
const rate = (action) => signed(world().yaw_rate * (action / straight() - 1)); // rad/s
const inWords = (a) => (a === straight() ? "flies straight on" : `turns ${a > straight() ? "left" : "right"} (${rate(a)} rad/s)`);
const crossed = ({ record: { outcome } }) => outcome === "goal" || outcome === "far";
const set = (node, values) => Object.entries(values).forEach(([key, x]) => node.setAttribute(key, x)) || node;
const say = (text) => void ($("hint").textContent === text || ($("hint").textContent = text)); // read aloud once
const writeAddress = () => history.replaceState(null, "", `#${new URLSearchParams({ ...episode.choice, t, actions: episode.actions })}`);

// -------------------------------------------------- the server
async function post(path, content) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(content) });
  if (answer.ok) return answer.json();
  throw new Error((await answer.text()).trim());
}

const ask = (path, { world, weights, seed }, more) => post(path, { world, weights, seed, ...more });

// Fly these actions, then let the pilot fly `more` steps, and add what is not known yet.
async function extend(to, actions, more = 0, pilot = "network") {
  const since = String(to.moments.length);
  const answer = await ask("/fly", to.choice, { actions, pilot, more: String(more), since });
  return Object.assign(to, answer, { moments: [...to.moments, ...answer.moments], actions: answer.record.actions });
}

// Whether it went well. What fails is told in a line.
async function attempt(action) {
  try {
    await action();
    return true;
  } catch (error) {
    pause();
    say(error instanceof TypeError ? `The server does not answer: ${error.message}` : error.message);
  }
}

// -------------------------------------------------- episodes
async function begin(actions, moment) {
  const me = ++generation;
  release();
  pause();
  if (!/^[0-9]{1,18}$/.test(chosen.seed)) throw new Error("The forest is a whole number of at most 18 digits.");
  const found = await extend({ choice: chosen, moments: [] }, actions);
  if (me !== generation) return;
  [episode, ghost, plain] = [found, null, null];
  drawForest();
  setReasons(null);
  show(Math.min(moment || 0, end()));
  help();
  if (!byHand() && moment === null) play();
  while (!byHand() && !over()) {
    await extend(found, found.actions, 25, chosen.pilot);
    if (me !== generation) return;
    show(playing || t >= moment ? t : Math.min(moment, end()));
  }
  if (chosen.pilot === "network") return;
  const other = await extend({ choice: chosen, label: "network", moments: [] }, "", world().max_steps);
  if (me !== generation) return;
  [plain, ghost] = [other, ghost || other];
  draw();
}

// What one can do now.
function help() {
  if (playing) say(steers() ? "Hold ← or → to turn harder. Space pauses." : "");
  else if (!steers()) say("Drag the time line. Click a trunk or a bar to ask the network. Or take over, and do better.");
  else if (t) say("You have the controls: ← or → fly on from here, space flies straight on.");
  else say("Press ← or → to take off. Hold to turn harder. The network flies along as a ghost.");
}

async function steer() {
  if (underway) return;
  const [me, mine, start] = [generation, asked, performance.now()];
  underway = extend(episode, episode.actions + turn()).finally(() => (underway = null));
  await underway;
  if (me !== generation) return;
  show(end());
  requestAnimationFrame(() => performance.measure("step to frame", { start }));
  if (mine === asked) help();
  if (!over()) return;
  pause();
  say(`You: ${ended(episode)}. R flies this forest again, N the next one. Or drag the time line, and ask why.`);
}

function turn() {
  const on = (side) => stick.held[side] || stick.tapped[side] || 0;
  const side = on("left") - on("right");
  stick.level = side && side === stick.side ? Math.min(stick.level + 1, straight()) : Math.abs(side);
  [stick.side, stick.tapped] = [side, {}];
  return straight() + side * stick.level;
}

const release = () => Object.assign(stick, { held: {}, tapped: {} });

function hold(side, down) {
  stick.held[side] = down ? 1 : 0;
  if (!down) return;
  if (!steers()) pause(); // what was asked is dropped
  if (!steers()) return say("To steer, go to a moment before the end and press Take over here. Or press R: the forest again.");
  stick.tapped[side] = 1;
  play();
}

// As it was until moment `from`, then another turn for some steps, then the network to the end.
async function otherwise(from, action, steps) {
  const label = `what if ${rate(action)} at ${clock(from)}`;
  const words = `The dashed path ${inWords(action)} at ${clock(from)} for ${clock(steps)}, then the network flies on`;
  const other = { ...episode, from, label, words, whole: true, record: { outcome: "" } };
  [other.moments, other.actions] = [episode.moments.slice(0, from), episode.actions.slice(0, from)];
  // The turn may end the episode, and no action can follow that.
  for (let i = 0; i < steps && !other.record.outcome; i++) await extend(other, other.actions + action);
  return extend(other, other.actions, world().max_steps);
}

async function whatIf(action) {
  const me = await settle();
  if (me !== asked) return;
  if (t === end() && over()) return say("The episode ends here. Step back, and ask again.");
  const other = await otherwise(t, action, Number($("hold").value));
  if (me !== asked) return;
  ghost?.words === other.words ? clear() : compare(other); // the same bar again takes it away
}

function compare(other, known = "") {
  ghost = other;
  show(other.from);
  say(`${known}${other.words}: ${ended(other)}, total reward ${number(other.record.return)}. Esc, or the same bar, takes it away.`);
}

function clear() {
  pause();
  ghost = plain;
  setReasons(null);
  draw();
}

// The last moment at which another turn saves the episode. It is flown, so the answer is exact.
async function wentWrong() {
  const [me, steps] = [await settle(), Math.round(0.5 / world().dt)];
  if (me !== asked) return;
  if (!over()) return say("This episode is not over. Fly it to its end first.");
  if (crossed(episode)) return say(`Nothing went wrong: ${ended(episode)}.`);
  let from = end();
  while (from >= steps && from > end() - 10 * steps) {
    from -= steps;
    say(`The network tries whether another turn at ${clock(from)} would have saved it.`);
    for (const action of [2 * straight(), straight(), 0]) {
      const other = await otherwise(from, action, steps);
      if (me !== asked) return;
      if (crossed(other)) return compare(other, `Of each half second, the last way out was at ${clock(from)}. `);
    }
  }
  const nothing = `Nothing saves it: left, straight on and right for 0.5 s were tried at each half second from ${clock(from)} on.`;
  if (!isQ()) return say(nothing);
  const best = episode.moments.map(({ q }) => Math.max(...q));
  const falls = best.slice(1, -1).map((x, i) => best[i] - x);
  show(Math.max(falls.indexOf(Math.max(...falls)), 0));
  say(`${nothing} After ${clock(t)} the greatest Q falls most.`);
}

// -------------------------------------------------- why
async function why(trunk = null) {
  const [me, at] = [await settle(), t];
  const answer = reasons || (await ask("/why", episode.choice, { actions: episode.actions, time: String(at) }));
  if (me !== asked || at !== t) return;
  setReasons(answer, removed && removed.trunk === trunk ? null : trunk);
  draw();
  if (trunk !== null && answer.without.every((x) => x.trunk !== trunk)) say("That is in none of the four frames: without it nothing would change.");
}

function setReasons(answer, trunk = null) {
  const things = answer ? [...answer.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight)) : [];
  [reasons, removed] = [answer, things.find((x) => x.trunk === trunk) || null];
  $("answer").hidden = !answer;
  $("turn").textContent = answer ? rate(answer.chosen) : "";
  $("things").replaceChildren();
  for (const x of things.slice(0, 8)) {
    const name = x.trunk < 0 ? "the goal's pole" : `trunk ${whereabouts(episode.trunks[x.trunk])}`;
    const button = addButton($("things"), `${name} ${signed(x.weight)}`, () => attempt(() => why(x.trunk)));
    set(button, { class: x.weight > 0 ? "for" : "against", "aria-pressed": x === removed });
  }
  drawTrunks();
}

function whereabouts([x, y]) {
  const [px, py, heading] = episode.moments[t].pose;
  const left = (y - py) * Math.cos(heading) - (x - px) * Math.sin(heading);
  return `${Math.hypot(x - px, y - py).toFixed(0)} m off, ${Math.abs(left).toFixed(1)} m ${left > 0 ? "left" : "right"}`;
}

function clickMap(event) {
  const place = new DOMPoint(event.clientX, event.clientY).matrixTransform($("map").getScreenCTM().inverse());
  const things = episode.trunks.map((trunk, i) => [i, trunk]);
  if (world().beacon) things.push([-1, [world().length, 0]]);
  const far = things.map(([i, [x, y]]) => [Math.hypot(x - place.x, y + place.y), i]).sort((a, b) => a[0] - b[0]);
  if (far[0][0] < 2.5) attempt(() => why(far[0][1]));
}

// -------------------------------------------------- play
const play = () => playing || setPlaying(true);
const pause = () => setPlaying(false);

// Before a question: pause, and let a step that is underway arrive, because it moves t.
async function settle() {
  pause();
  const me = asked;
  await underway;
  return me;
}

function setPlaying(on) {
  [playing, asked] = [on, asked + 1];
  $("play").textContent = on ? "Pause" : "Play";
  if (episode) help();
  if (on) attempt(loop);
}

async function loop() {
  let [me, due] = [asked, performance.now()];
  if (t === end() && over()) show(0);
  while (playing && me === asked) {
    if (t < end()) show(t + 1);
    else if (over()) pause();
    else if (byHand()) await steer();
    due = Math.max(due + (1000 * world().dt) / Number($("speed").value), performance.now());
    await new Promise((wake) => setTimeout(wake, due - performance.now()));
  }
}

function stepTo(moment) {
  show(Math.max(Math.min(moment, end()), 0));
  pause();
  if (moment > end() && steers()) attempt(steer);
}

function show(moment) {
  if (moment !== t && reasons) setReasons(null);
  t = moment;
  const { choice, record } = episode;
  const name = `${choice.world} ${record.seed} ${record.actions}`;
  if (choice.pilot === "you" && over()) sessionStorage.done = JSON.stringify([...done.set(name, { world: choice.world, ...record })]);
  draw();
}

// -------------------------------------------------- drawing
function drawForest() {
  const { length, width, back, num_actions, beacon } = world();
  set($("map"), { viewBox: `-4 ${-width / 2 - 2} ${length + 8} ${width + 4}` });
  set($("ground"), { x: -back, y: -width / 2, width: length + back, height: width });
  set($("goal"), { cx: length });
  set($("pole"), { cx: length, r: beacon ? 0.7 : 0 });
  const circle = ([cx, y]) => set(document.createElementNS("http://www.w3.org/2000/svg", "circle"), { cx, cy: -y });
  $("trunks").replaceChildren(...episode.trunks.map(circle));
  for (let a = num_actions - 1; a >= 0 && $("bars").children.length < num_actions; a--) {
    const bar = addButton($("bars"), "", () => attempt(() => whatIf(a)));
    bar.innerHTML = `<span></span><span class="well"><i></i><i class="other"></i></span><span class="rate">${rate(a)}</span><span class="after"></span>`;
  }
}

function draw() {
  paint($("seen"), removed ? removed.frame : episode.moments[t].frame);
  [...$("stack").children].forEach((canvas, i) => paint(canvas, episode.moments[Math.max(t - 3 + i, 0)].frame));
  [drawMap, drawBars, drawCurves, drawTable].forEach((part) => part());
  $("time").max = end();
  $("time").value = t;
  set($("time"), { "aria-valuetext": clock(t) });
  $("clock").textContent = `${clock(t)} of ${clock(end())}`;
  const banner = t === end() && over() && `${ended(episode)}, total reward ${number(episode.record.return)}`;
  $("banner").textContent = removed ? `without ${removed.trunk < 0 ? "the goal's pole" : "this trunk"} (Esc puts it back)` : banner || "";
}

function paint(canvas, frame) {
  const [grey, image] = [atob(frame), new ImageData(PIXELS, PIXELS)];
  const colours = new Uint32Array(image.data.buffer);
  for (let i = 0; i < grey.length; i++) colours[i] = 0xff000000 + 0x10101 * grey.charCodeAt(i);
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function drawMap() {
  const path = (moments) => moments.map(({ pose: [x, y] }) => `${x.toFixed(2)},${(-y).toFixed(2)}`).join(" ");
  const place = ([x, y, heading]) => `translate(${x} ${-y}) rotate(${(-heading * 180) / Math.PI})`;
  const edge = world().view * Math.tan(options.half_view);
  for (const id of ["drone", "view"]) set($(id), { transform: place(episode.moments[t].pose) });
  set($("view"), { d: `M0 0L${world().view} ${edge}V${-edge}Z` });
  set($("whole-path"), { points: path(episode.moments) });
  set($("path"), { points: path(episode.moments.slice(0, t + 1)) });
  // Who flies by hand should not see where the ghost is going to turn.
  const known = ghost ? ghost.moments.slice(0, byHand() && !over() && !ghost.whole ? t + 1 : undefined) : [];
  set($("ghost-path"), { points: path(known) });
  const at = ghost && ghost.moments[Math.min(t, ghost.moments.length - 1)].pose;
  set($("ghost"), { transform: at ? place(at) : "translate(-99 0)" });
  [$("main-name").textContent, $("ghost-name").textContent] = [chosen.pilot, ghost ? ghost.label : ""];
  $("ghost-mark").hidden = !ghost;
}

function drawTrunks() {
  const found = new Map((reasons ? reasons.without : []).map((x) => [x.trunk, x]));
  const most = Math.max(...[...found.values()].map((x) => Math.abs(x.weight)), 1e-9);
  const colour = (node, x, r) => {
    const share = x ? Math.abs(x.weight) / most : 0;
    const kind = !x ? "" : x === removed ? "removed" : x.weight > 0 ? "for" : "against";
    set(node, { class: kind, r: r * (1 + share), "fill-opacity": x ? 0.3 + 0.7 * share : 1 });
  };
  colour($("goal"), found.get(-1), world().goal_radius);
  [...$("trunks").children].forEach((circle, i) => colour(circle, found.get(i), 1.2 * world().trunk_radius));
}

function drawBars() {
  const [q, other] = [episode.moments[t].q, removed && removed.q];
  const [low, high] = [Math.min(...q, ...(other || q)), Math.max(...q, ...(other || q))];
  const height = (x) => `${(100 * (x - low)) / Math.max(high - low, 1e-9)}%`;
  [...$("bars").children].forEach((bar, i) => {
    const a = q.length - 1 - i; // the sharpest left turn stands leftmost
    const [value, { children: [before, without] }, , after] = bar.children;
    [value.textContent, after.textContent] = [number(q[a]), other ? number(other[a]) : ""];
    [before.style.height, without.style.height, without.hidden] = [height(q[a]), height(other ? other[a] : low), !other];
    bar.classList.toggle("best", q[a] === Math.max(...q));
    bar.classList.toggle("flown", episode.actions[t] === String(a));
    set(bar, { "aria-label": `${rate(a)} radians a second: ${score()} ${number(q[a])}. What if it turned so?` });
  });
}

function drawCurves() {
  const curve = ([key, name]) => {
    const values = episode.moments.map((moment) => moment[key]);
    const [low, high] = [Math.min(0, ...values), Math.max(1, ...values)];
    const x = (moment) => ((100 * moment) / Math.max(end(), 1)).toFixed(2);
    const points = values.map((value, moment) => `${x(moment)} ${(30 - (30 * (value - low)) / (high - low)).toFixed(2)}`);
    return `<div class="curve"><span>${name} <b>${number(values[t])}</b></span><svg viewBox="0 0 100 30" preserveAspectRatio="none"
      aria-hidden="true"><path d="M${points.join("L")}"/><path d="M${x(t)} 0V30"/></svg></div>`;
  };
  const curves = { reward: "reward", return: "total reward", d_obs: "nearest trunk, m" };
  $("curves").innerHTML = Object.entries(curves).map(curve).join("");
}

function drawTable() {
  const episodes = [{ ...episode, label: chosen.pilot }, ghost].filter(Boolean);
  const known = (f) => ended(f) && (over() || f.whole);
  const rows = { end: ended, steps: (f) => f.record.steps, "total reward": (f) => number(f.record.return) };
  const line = (name, cell) => `<tr><th scope="row">${name}</th>${episodes.map((f) => `<td>${cell(f)}</td>`).join("")}</tr>`;
  const body = Object.entries(rows).map(([name, cell]) => line(name, (f) => (known(f) ? cell(f) : "…")));
  $("table").innerHTML = line("", (f) => `<b>${f.label}</b>`) + body.join("");
}

// -------------------------------------------------- choices, address, file
function addButton(parent, text, action) {
  const button = parent.appendChild(document.createElement("button"));
  button.textContent = text;
  button.addEventListener("click", action);
  return button;
}

async function choose(change, actions = "", moment = null) {
  const after = (chosen = { ...chosen, ...change });
  chosen.weights ||= Object.keys(world().weights)[0];
  drawChoices();
  const well = await attempt(() => begin(actions, moment));
  if (!well && episode && chosen === after) chosen = episode.choice;
  drawChoices();
  return well;
}

function drawChoices() {
  const names = { pilot: options.pilots, world: Object.keys(options.worlds) };
  for (const [key, all] of Object.entries(names)) {
    const row = $(`${key}s`);
    const add = (name) => addButton(row, name, () => choose(key === "world" ? { world: name, weights: "" } : { pilot: name }));
    if (!row.children.length) all.forEach((name) => set(add(name), { title: MEANING[name] || "" }));
    for (const button of row.children) set(button, { "aria-pressed": button.textContent === chosen[key] });
    if (key === "world") all.forEach((name, i) => (row.children[i].disabled = !Object.keys(options.worlds[name].weights).length));
  }
  $("weights").replaceChildren(...Object.keys(world().weights).map((name) => new Option(name, name, false, name === chosen.weights)));
  $("seed").value = chosen.seed;
  $("stick").hidden = !byHand();
  [$("q").hidden, $("scores").hidden] = [!isQ(), isQ()];
  document.querySelectorAll(".score").forEach((node) => (node.textContent = score()));
}

async function restore() {
  const told = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const first = { pilot: "you", world: Object.keys(options.worlds)[0], seed: told.seed || "1", weights: told.weights };
  if (options.pilots.includes(told.pilot)) first.pilot = told.pilot;
  if (told.world in options.worlds && Object.keys(options.worlds[told.world].weights).length) first.world = told.world;
  if (await choose(first, told.actions, Math.trunc(Math.abs(Number(told.t))) || 0) || episode) return;
  const wrong = $("hint").textContent;
  if (await choose({ seed: "1", weights: "" })) say(wrong);
}

async function share() {
  pause();
  writeAddress();
  const copied = await navigator.clipboard.writeText(location.href).then(() => " It is copied.", () => "");
  say(`The address of this page holds this episode at this moment.${copied} It opens where a cockpit runs at ${location.host}.`);
}

function save() {
  pause();
  const episodes = [...done.values()].filter((f) => f.world === chosen.world && f.seed < options.train_end);
  const out = done.size - episodes.length;
  const left = out ? ` Left out: ${out}, of another world, or of a forest from 1,000,000,000 up (those are for validation and tests).` : "";
  if (!episodes.length) return say(`There is no episode to save. Fly by hand to an end, in a forest below 1,000,000,000.${left}`);
  const { beacon, camera } = world();
  const pilots = { you: { episodes: episodes.map(({ world, ...record }) => record) } };
  const file = new Blob([JSON.stringify({ beacon, camera, pilots })], { type: "application/json" });
  Object.assign(document.createElement("a"), { href: URL.createObjectURL(file), download: "episodes.json" }).click();
  const flags = (beacon ? " --beacon" : "") + (camera === "grey" ? "" : ` --camera ${camera}`);
  say(`Episodes in the file episodes.json: ${episodes.length}.${left}
    To learn from them: .venv/bin/python -m extras.lessons.demonstrations train --demos FILE --demo-pilot you${flags}`);
}

// -------------------------------------------------- keys and buttons
const actions = {
  play: () => (playing ? pause() : play()),
  back: () => stepTo(t - 1),
  step: () => stepTo(t + 1),
  next: () => choose({ seed: String(BigInt(chosen.seed) + 1n) }),
  again: () => choose({}),
  random: () => choose({ seed: String(Math.floor(Math.random() * options.train_end)) }),
  why: () => attempt(() => why()),
  take: () => choose({ pilot: "you" }, episode.actions.slice(0, over() ? Math.min(t, end() - 1) : t), t),
  wrong: () => attempt(wentWrong),
  clear, share, save,
};
const KEYS = { " ": "play", ",": "back", ".": "step", n: "next", r: "again", w: "why", Escape: "clear" };
const SIDES = { ArrowLeft: "left", a: "left", ArrowRight: "right", d: "right" };

function key(event) {
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const own = event.target.matches("input, select") || (name === " " && event.target.matches("button"));
  const [side, action] = [SIDES[name], actions[KEYS[name]]];
  if (side && event.type === "keyup") hold(side, false); // whatever has the focus
  if (own || event.ctrlKey || event.metaKey || event.altKey || !episode || !(side || action)) return;
  event.preventDefault();
  if (event.type === "keyup") return;
  if (side && !event.repeat) hold(side, true);
  if (action) action();
}

function listen() {
  const on = (id, event, action) => $(id).addEventListener(event, action);
  for (const type of ["keydown", "keyup"]) document.addEventListener(type, key);
  window.addEventListener("blur", release);
  window.addEventListener("hashchange", restore);
  document.addEventListener("visibilitychange", () => document.hidden && (release(), pause()));
  // What was clicked by a mouse would keep the focus, and take the keys that steer.
  document.addEventListener("click", (event) => event.detail && event.target.matches("button, #time") && event.target.blur());
  for (const side of ["left", "right"]) {
    on(side, "pointerdown", () => hold(side, true));
    for (const name of ["pointerup", "pointerleave", "pointercancel"]) on(side, name, () => hold(side, false));
  }
  for (const [name, action] of Object.entries(actions)) if ($(name)) on(name, "click", () => episode && action());
  on("map", "click", clickMap);
  on("time", "input", () => stepTo(Number($("time").value)));
  on("seed", "change", () => choose({ seed: $("seed").value.trim() }));
  on("weights", "change", () => choose({ weights: $("weights").value }));
  for (const id of ["seed", "weights", "hold", "speed"]) on(id, "change", () => $(id).blur());
}

attempt(async () => {
  options = await post("/options", {});
  listen();
  await restore();
  // Not at each change, because browsers complain if the address changes many times a second.
  setInterval(() => episode && !playing && writeAddress(), 500);
});
