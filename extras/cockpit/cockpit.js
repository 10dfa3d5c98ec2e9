"use strict";
// The page of the cockpit. It shows what the server answers, and knows no rule of the world.
// An episode has moments; each has pose, reward, return, d_obs, q, and a frame.
// learning.js is the other view, of a training.

const $ = (id) => document.getElementById(id);
const [PIXELS, NEAR, SHOWN] = [84, 2.5, 6]; // NEAR: m, from the pointer to what it means; SHOWN: reasons in words
const ENDS = { goal: "arrived", far: "left by the far edge", side: "left by a side", back: "left by the back", crash: "hit a trunk", time: "ran out of time" };
const MEANING = {
  you: "You steer.", network: "The network chosen at the right.", random: "Any turn, each as likely.", straight: "Never turns.",
  laser: "A planner that measures where the trunks are: more than the camera shows.", plain: "The paper's world. Nothing marks the goal.",
  beacon: "A pole stands at the goal, and can be seen.", disparity: "The frames show how near things are.",
};
const RECORDED = "recorded"; // the pilot of a training's validation episode, which is whole from the start
const touch = matchMedia("(pointer: coarse)").matches;
const [ARROWS, SPACE, GO] = touch ? ["◀ left or right ▶", "Play", "Play"] : ["← or →", "space", "Space or Play"];
let options; // what one may choose from, and the numbers of each world
let chosen = {}; // world, weights, seed, pilot
let episode = null; // the episode on show: choice, moments, record, actions, trunks
let [ghost, plain] = [null, null]; // another one through the same forest, and its label; the one to go back to
let t = 0; // the moment on show
let [reasons, removed] = [null, null]; // the answer to "why" of moment t; what is taken out on show
let [playing, underway] = [false, null]; // underway: the promise of a step that the server has not answered
let [generation, asked] = [0, 0]; // of episodes, and of what was asked: what an older one waited for is dropped
let kept = {}; // a browser may refuse storage; then a reload forgets what was flown by hand
try { kept = sessionStorage; } catch {}
const done = new Map(JSON.parse(kept.done || "[]")); // flown by hand to their end, each once
const stick = { held: {}, tapped: {}, side: 0, level: 0 };

const world = () => options.worlds[chosen.world];
const end = () => episode.moments.length - 1;
const over = () => episode.record.outcome !== "";
const ended = ({ record: { outcome } }) => ENDS[outcome];
const isQ = () => world().weights[chosen.weights] === "dqn"; // an imitated network scores, and knows no return
const score = () => (isQ() ? "Q" : "score");
const byHand = () => chosen.pilot === "you";
const recorded = () => chosen.pilot === RECORDED;
const who = () => (recorded() ? `after ${thousands(chosen.step)} steps` : chosen.pilot);
const steers = () => byHand() && t === end() && !over();
const straight = () => (world().num_actions - 1) / 2;
const number = (x) => (Math.round(10 * x) / 10 || 0).toFixed(1).replace("-", "−"); // never −0.0
const thousands = (x) => Number(x).toLocaleString("en");
const clock = (moment) => `${(moment * world().dt).toFixed(1)} s`;
const signed = (x) => (x < 0 ? "−" : "+") + Math.abs(x).toFixed(2).replace(/^0/, "");
const rate = (action) => signed(world().yaw_rate * (action / straight() - 1)); // rad/s
const inWords = (a) => (a === straight() ? "flies straight on" : `turns ${a > straight() ? "left" : "right"} (${rate(a)} rad/s)`);
const crossed = ({ record: { outcome } }) => outcome === "goal" || outcome === "far";
const mean = (values) => values.reduce((sum, x) => sum + x) / values.length;
const above = (values) => values.map((x) => x - mean(values));
const svg = (kind) => document.createElementNS("http://www.w3.org/2000/svg", kind);
const kind = (x) => (x === removed ? "removed" : x.weight > 0 ? "for" : "against");
const pointed = (event, map) => new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
const addButton = (parent, textContent, onclick) => parent.appendChild(Object.assign(document.createElement("button"), { textContent, onclick }));
const set = (node, values) => Object.entries(values).forEach(([key, x]) => node.setAttribute(key, x)) || node;
const say = (text) => void ($("hint").textContent === text || ($("hint").textContent = text)); // read aloud once
const writeAddress = () => history.replaceState(null, "", `#${new URLSearchParams(learning() ? place : { ...episode.choice, t, actions: episode.actions })}`);

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
    if (playing) pause();
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
  if (!byHand() && moment === null && !learning()) play();
  while (!byHand() && !recorded() && !over()) {
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
  if (learning()) say(touch ? "Tap a way to fly that episode, or a curve to go there." : "← and → go through the training, and so does a click on a curve. Click a way to fly that episode.");
  else if (!episode) return;
  else if (playing && recorded()) say(`${chosen.training}, ${who()} of training. Learning goes back to all episodes.`);
  else if (playing) say(steers() ? `Hold ${ARROWS} to turn harder. ${touch ? "Pause" : "Space"} pauses.` : "");
  else if (!steers()) say(`Press ${GO}, or drag the time line. Click a trunk or a bar to ask the network. Or take over, and do better.`);
  else if (t) say(`You have the controls: ${ARROWS} fly on from here, ${SPACE} flies straight on.`);
  else say(`Press ${ARROWS} to take off. Hold to turn harder. The network flies along as a ghost.`);
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
  say(`You: ${ended(episode)}. ${touch ? "Again flies this forest again, Next" : "R flies this forest again, N"} the next one. Or drag the time line, and ask why.`);
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
  if (!steers()) pause(); // what was asked is dropped
  if (!steers()) return say("To steer, go to a moment before the end and press Take over here. Or press Again.");
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
  say(`${known}${other.words}: ${ended(other)}, return ${number(other.record.return)}. Esc, or the same bar, takes it away.`);
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
  if (crossed(episode)) return say(`Nothing went wrong: the drone ${ended(episode)}.`);
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
  const [me, moment] = [await settle(), t];
  const answer = reasons || (await ask("/why", episode.choice, { actions: episode.actions, time: String(moment) }));
  if (me !== asked || moment !== t) return;
  setReasons(answer, removed && removed.trunk === trunk ? null : trunk);
  draw();
  if (trunk !== null && answer.without.every((x) => x.trunk !== trunk)) say("That is in none of the four frames: without it nothing would change.");
}

function setReasons(answer, trunk = null) {
  const things = answer ? [...answer.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight)) : [];
  [reasons, removed] = [answer, things.find((x) => x.trunk === trunk) || null];
  const lead = answer && signed(above(answer.before)[answer.chosen]).slice(1);
  $("answer").innerHTML = !answer ? "" : `<p>The network ${inWords(answer.chosen)}: this ${score()} is ${lead} above the mean of the nine. The numbers say how much
    of that is lost without one trunk: <b class="for">+ is a reason for</b> the turn, <b class="against">− a reason against</b> it.</p><div></div>`;
  for (const x of things.slice(0, SHOWN)) {
    const name = x.trunk < 0 ? "the goal's pole" : whereabouts(episode.trunks[x.trunk]);
    const button = addButton($("answer").lastChild, `${name} ${signed(x.weight)}`, () => attempt(() => why(x.trunk)));
    set(button, { class: x.weight > 0 ? "for" : "against", "aria-pressed": x === removed });
  }
  $("marks").innerHTML = things.slice(0, SHOWN).map(outline).join("");
  drawTrunks();
}

// Where a thing stands in the newest frame: around the pixels that change without it.
function outline(x) {
  const [before, after] = [episode.moments[t].frame, x.frame].map(atob);
  const changed = [...before].flatMap((pixel, i) => (pixel === after[i] ? [] : [i]));
  const span = (of) => [Math.min(...changed.map(of)), Math.max(...changed.map(of)) + 1];
  const [[left, right], [top, low]] = [span((i) => i % PIXELS), span((i) => Math.floor(i / PIXELS))];
  return changed.length ? `<rect class="${kind(x)}" x="${left}" y="${top}" width="${right - left}" height="${low - top}"/>` : "";
}

function whereabouts([x, y]) {
  const [px, py, heading] = episode.moments[t].pose;
  const left = (y - py) * Math.cos(heading) - (x - px) * Math.sin(heading);
  return `${Math.hypot(x - px, y - py).toFixed(0)} m off, ${Math.abs(left).toFixed(1)} m ${left > 0 ? "left" : "right"}`;
}

function clickMap(event) {
  const { x: px, y: py } = pointed(event, $("map"));
  const things = [...episode.trunks.entries(), ...(world().beacon ? [[-1, [world().length, 0]]] : [])];
  const far = things.map(([i, [x, y]]) => [Math.hypot(x - px, y + py), i]).sort((a, b) => a[0] - b[0]);
  if (far[0][0] < NEAR) attempt(() => why(far[0][1]));
}

// -------------------------------------------------- play
const release = () => Object.assign(stick, { held: {}, tapped: {} });
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
  help();
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
  const { choice: { world, pilot }, record } = episode;
  const name = `${world} ${record.seed} ${record.actions}`;
  if (pilot === "you" && over()) kept.done = JSON.stringify([...done.set(name, { world, ...record })]);
  draw();
}

// -------------------------------------------------- drawing
// The empty forest of a map.
function drawGround(map, { length, width, back, goal_radius }) {
  set(map, { viewBox: `${-back - 1} ${-width / 2 - 1} ${length + back + 5} ${width + 2}` });
  set(map.querySelector(".ground"), { x: -back, y: -width / 2, width: length + back, height: width });
  set(map.querySelector(".goal"), { cx: length, r: goal_radius });
}

function drawForest() {
  const { length, num_actions, beacon } = world();
  drawGround($("map"), world());
  set($("pole"), { cx: length, r: beacon ? 0.7 : 0 });
  const circle = ([cx, y]) => set(svg("circle"), { cx, cy: -y });
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
  [$("time").max, $("time").value] = [end(), t];
  set($("time"), { "aria-valuetext": clock(t) });
  $("clock").textContent = `${clock(t)} of ${clock(end())}`;
  const banner = t === end() && over() && `${ended(episode)}, return ${number(episode.record.return)}`;
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
  [$("main-name").textContent, $("ghost-name").textContent, $("ghost-mark").hidden] = [who(), ghost ? ghost.label : "", !ghost];
}

function drawTrunks() {
  const found = new Map((reasons ? reasons.without : []).map((x) => [x.trunk, x]));
  const most = Math.max(...[...found.values()].map((x) => Math.abs(x.weight)), 1e-9);
  const colour = (node, x, r) => {
    const share = x ? Math.abs(x.weight) / most : 0;
    set(node, { class: x ? kind(x) : node.id, r: r * (1 + share), "fill-opacity": x ? 0.3 + 0.7 * share : 1 });
  };
  colour($("goal"), found.get(-1), world().goal_radius);
  [...$("trunks").children].forEach((circle, i) => colour(circle, found.get(i), 1.2 * world().trunk_radius));
}

function drawBars() {
  const [q, other] = [episode.moments[t].q, removed && removed.q];
  const [own, without] = [above(q), above(other || q)];
  const reach = 2 ** Math.ceil(Math.log2(Math.max(0.1, ...own.map(Math.abs), ...without.map(Math.abs))));
  const stretch = ({ style }, x) => ([style.top, style.height] = [`${50 - (50 * Math.max(x, 0)) / reach}%`, `${(50 * Math.abs(x)) / reach}%`]);
  $("scale").textContent = `line: the mean, ${number(mean(q))}; frame: ±${reach}`;
  [...$("bars").children].forEach((bar, i) => {
    const a = q.length - 1 - i; // the sharpest left turn stands leftmost
    const [value, { children: [first, second] }, , after] = bar.children;
    [value.textContent, after.textContent, second.hidden] = [number(q[a]), other ? number(other[a]) : "", !other];
    stretch(first, own[a]);
    stretch(second, without[a]);
    bar.classList.toggle("best", q[a] === Math.max(...q));
    bar.classList.toggle("flown", episode.actions[t] === String(a));
    set(bar, { "aria-label": `${rate(a)} radians a second: ${score()} ${number(q[a])}. What if it turned so?` });
  });
}

// A line through points [x, y], x from 0 to 1, with a cursor, over a band of [x, least, greatest].
function curve(name, value, line, cursor, band = []) {
  const ys = [...line, ...band].flatMap(([, ...y]) => y);
  const [low, high] = [Math.min(0, ...ys), Math.max(1, ...ys)];
  const place = ([x, y]) => `${(100 * x).toFixed(2)} ${(30 - (30 * (y - low)) / (high - low)).toFixed(2)}`;
  const path = (kind, points) => (points.length ? `<path class="${kind}" fill="none" stroke-width="1.5" vector-effect="non-scaling-stroke" d="M${points.map(place).join("L")}"/>` : "");
  const around = [...band, ...band.map(([x, , greatest]) => [x, greatest]).reverse()];
  const paths = [path("band", around), path("line", line), path("cursor", [[cursor, low], [cursor, high]])].join("");
  return `<div class="curve"><span>${name} <b>${number(value)}</b></span><svg viewBox="0 0 100 30" preserveAspectRatio="none"
    aria-hidden="true">${paths}</svg><small><i>${number(high)}</i><i>${number(low)}</i></small></div>`;
}

function drawCurves() {
  const share = (moment) => moment / Math.max(end(), 1);
  const line = (key) => episode.moments.map((moment, i) => [share(i), moment[key]]);
  const names = Object.entries({ reward: "reward", return: "return so far", d_obs: "nearest trunk, m" });
  $("curves").innerHTML = names.map(([key, name]) => curve(name, episode.moments[t][key], line(key), share(t))).join("");
}

function drawTable() {
  const episodes = [{ ...episode, label: who() }, ghost].filter(Boolean);
  const known = (f) => ended(f) && (over() || f.whole);
  const rows = { end: ended, steps: (f) => f.record.steps, return: (f) => number(f.record.return) };
  const line = (name, cell) => `<tr><th scope="row">${name}</th>${episodes.map((f) => `<td>${cell(f)}</td>`).join("")}</tr>`;
  const body = Object.entries(rows).map(([name, cell]) => line(name, (f) => (known(f) ? cell(f) : "…")));
  $("table").innerHTML = line("", (f) => `<b>${f.label}</b>`) + body.join("");
}

// -------------------------------------------------- choices, address, file
async function choose(change, actions = "", moment = null) {
  const after = (chosen = { ...chosen, ...change });
  if (recorded() && !actions) chosen.pilot = "network"; // in another forest
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
    const row = $(`${key}s`), add = (name) => addButton(row, name, () => choose(key === "world" ? { world: name, weights: "" } : { pilot: name }));
    if (!row.children.length) all.forEach((name) => set(add(name), { title: MEANING[name] || "" }));
    for (const button of row.children) set(button, { "aria-pressed": button.textContent === chosen[key] });
    if (key === "world") all.forEach((name, i) => (row.children[i].disabled = !Object.keys(options.worlds[name].weights).length));
  }
  $("weights").replaceChildren(...Object.keys(world().weights).map((name) => new Option(name, name, false, name === chosen.weights)));
  $("seed").value = chosen.seed;
  [$("stick").hidden, $("q").hidden, $("scores").hidden] = [!byHand(), !isQ(), isQ()];
}

async function restore() {
  const told = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const first = { pilot: "you", world: Object.keys(options.worlds)[0], seed: told.seed || "1", weights: told.weights };
  if (options.pilots.includes(told.pilot)) first.pilot = told.pilot;
  if (told.world in options.worlds && Object.keys(options.worlds[told.world].weights).length) first.world = told.world;
  if (told.training) place = { training: told.training, step: told.step };
  if (told.pilot === RECORDED && told.training && told.step > 0) Object.assign(first, place, { pilot: RECORDED });
  if (!episode) chosen = first;
  if (told.training && !told.seed) return attempt(openLearning);
  setView(false);
  if (await choose(first, told.actions, Math.trunc(Math.abs(Number(told.t))) || 0) || episode) return;
  const wrong = $("hint").textContent;
  if (await choose({ seed: "1", weights: "" })) say(wrong);
}

async function share() {
  pause();
  writeAddress();
  const copied = await navigator.clipboard.writeText(location.href).then(() => " It is copied.", () => "");
  const what = learning() ? "this training at this validation" : "this episode at this moment";
  say(`The address of this page holds ${what}.${copied} It opens where a cockpit runs at ${location.host}.`);
}

function save() {
  pause();
  const episodes = [...done.values()].filter((f) => f.world === chosen.world && f.seed < options.train_end);
  const left = done.size === episodes.length ? "" : ` Left out: ${done.size - episodes.length}, of another world, or of a forest from 1,000,000,000 up (those are for validation and tests).`;
  if (!episodes.length) return say(`There is no episode to save. Fly by hand to an end, in a forest below 1,000,000,000.${left}`);
  const [{ beacon, camera }, pilots] = [world(), { you: { episodes: episodes.map(({ world, ...record }) => record) } }];
  const file = new Blob([JSON.stringify({ beacon, camera, pilots })], { type: "application/json" });
  Object.assign(document.createElement("a"), { href: URL.createObjectURL(file), download: "episodes.json" }).click();
  const flags = (beacon ? " --beacon" : "") + (camera === "grey" ? "" : ` --camera ${camera}`);
  say(`Episodes in the file episodes.json: ${episodes.length}.${left} To learn from them: .venv/bin/python -m extras.lessons.demonstrations train --demos FILE --demo-pilot you${flags}`);
}

// -------------------------------------------------- keys and buttons
const actions = {
  play: () => (playing ? pause() : play()), back: () => stepTo(t - 1), step: () => stepTo(t + 1),
  sooner: () => goTo(at - 1), later: () => goTo(at + 1), learning: () => attempt(openLearning), flying: openFlying,
  next: () => choose({ seed: String(BigInt(chosen.seed) + 1n) }),
  again: () => choose({}, recorded() ? episode.actions : ""),
  random: () => choose({ seed: String(Math.floor(Math.random() * options.train_end)) }),
  take: () => choose({ pilot: "you" }, episode.actions.slice(0, over() ? Math.min(t, end() - 1) : t), t),
  why: () => attempt(() => why()), wrong: () => attempt(wentWrong),
  clear, share, save,
};
const KEYS = { " ": "play", ",": "back", ".": "step", n: "next", r: "again", w: "why", Escape: "clear" };
const SIDES = { ArrowLeft: "left", a: "left", ArrowRight: "right", d: "right" };

function key(event) {
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const own = event.target.matches("input, select") || (name === " " && event.target.matches("button"));
  const [side, action] = [SIDES[name], actions[KEYS[name]]];
  if (side && event.type === "keyup") hold(side, false); // whatever has the focus
  if (own || event.type === "keyup" || event.ctrlKey || event.metaKey || event.altKey) return;
  if (learning()) return learningKey(event);
  if (!episode || !(side || action)) return;
  event.preventDefault();
  if (action) action();
  else if (!event.repeat) hold(side, true);
}

function listen() {
  const on = (id, event, action) => $(id).addEventListener(event, action);
  for (const type of ["keydown", "keyup"]) document.addEventListener(type, key);
  window.addEventListener("blur", release);
  window.addEventListener("hashchange", restore);
  document.addEventListener("visibilitychange", () => document.hidden && (release(), pause()));
  // What was clicked by a mouse would keep the focus, and take the keys that steer.
  document.addEventListener("click", (event) => event.detail && event.target.matches("button, [type=range]") && event.target.blur());
  const hands = Object.entries({ pointerdown: true, pointerup: false, pointerleave: false, pointercancel: false });
  for (const side of ["left", "right"]) for (const [name, down] of hands) on(side, name, () => hold(side, down));
  for (const [name, action] of Object.entries(actions)) if ($(name)) on(name, "click", () => (episode || learning()) && action());
  listenLearning(on);
  on("map", "click", clickMap);
  on("time", "input", () => stepTo(Number($("time").value)));
  on("seed", "change", () => choose({ seed: $("seed").value.trim() }));
  on("weights", "change", () => choose({ weights: $("weights").value }, recorded() ? episode.actions : ""));
  for (const id of ["seed", "weights", "hold", "speed"]) on(id, "change", () => $(id).blur());
}

attempt(async () => {
  options = await post("/options", {});
  listen();
  await restore();
  // Not at each change, because browsers complain if the address changes many times a second.
  setInterval(() => (learning() ? training : episode && !playing) && writeAddress(), 500);
});
