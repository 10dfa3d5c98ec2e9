"use strict";
// The page of the cockpit. It shows what the server answers, and knows no rule of the world.
// An episode has moments: pose, reward, return, d_obs, q, a frame, and maps where somebody looked inside.

const $ = (id) => document.getElementById(id);
const [NEAR, SHOWN] = [2.5, 6]; // m, from the pointer to what it means; how many reasons are told in words
const ENDS = { goal: "arrived", far: "left by the far edge", side: "left by a side", back: "left by the back",
  crash: "hit a trunk", time: "ran out of time" };
const MEANING = { you: "You steer.", network: "The network chosen at the right.", straight: "Never turns.",
  random: "Any turn, each as likely.", plain: "The paper's world. Nothing marks the goal.",
  laser: "A planner that measures where the trunks are: more than the camera shows.",
  beacon: "A pole stands at the goal, and can be seen.", disparity: "The frames show how near things are." };
const VALUES = { reward: "reward", return: "return so far", d_obs: "nearest trunk, m" };
const RECORDED = "recorded"; // the pilot of a training's validation episode, which is whole from the start
const touch = matchMedia("(pointer: coarse)").matches;
const [TAP, ARROWS, SPACE, GO, STOP] = touch ? ["Tap", "◀ left or right ▶", "Play", "Play", "Pause"] :
  ["Click", "← or →", "space", "Space or Play", "Space"];
let options; // what one may choose from, and the numbers of each world
let chosen = {}; // world, weights, seed, pilot
let episode = null; // the episode on show: choice, moments, record, actions, trunks
let [ghost, plain] = [null, null]; // another one through the same forest; the one to go back to
let t = 0; // the moment on show
let [reasons, removed] = [null, null]; // the answer to "why" of moment t; what is taken out on show
let answers = []; // what Esc takes away, the latest last; some may be gone already
let [inside, looking] = [false, null]; // whether the filters are on show; the promise of what they find
let [playing, underway] = [false, null]; // underway: the promise of a step
let asked = 0; // counts what was asked: what an older question waited for is dropped
let kept = {}; // a browser may refuse storage; then a reload forgets what was flown by hand
try { kept = sessionStorage; } catch {}
const done = new Map(JSON.parse(kept.done || "[]")); // flown by hand to their end, each once
const stick = { held: {}, tapped: {}, side: 0, level: 0 };

const world = () => options.worlds[chosen.world];
const weightsOf = (name) => Object.keys(options.worlds[name]?.weights || {});
const end = () => episode.moments.length - 1;
const over = () => episode.record.outcome !== "";
const crossed = ({ record: { outcome } }) => outcome === "goal" || outcome === "far";
const isQ = () => world().weights[chosen.weights] === "dqn"; // an imitation scores, and knows no return
const score = () => (isQ() ? "Q" : "score");
const byHand = () => chosen.pilot === "you";
const recorded = () => chosen.pilot === RECORDED;
const who = () => (recorded() ? `after ${thousands(chosen.step)} steps` : chosen.pilot);
const steers = () => byHand() && t === end() && !over();
const straight = () => (world().num_actions - 1) / 2;
const result = (e) => `${ENDS[e.outcome]} after ${clock(e.steps)}, return ${number(e.return)}`;
const number = (x) => (Math.round(10 * x) / 10 || 0).toFixed(1).replace("-", "−"); // never −0.0
const thousands = (x) => Number(x).toLocaleString("en");
const clock = (moment) => `${(moment * world().dt).toFixed(1)} s`;
const signed = (x) => (x < 0 ? "−" : "+") + Math.abs(x).toFixed(2).replace(/^0/, "");
const rate = (action) => signed(world().yaw_rate * (action / straight() - 1)); // rad/s
const side = (action) => (action > straight() ? "left" : "right");
const inWords = (a) => (a === straight() ? "flies straight on" : `turns ${side(a)} (${rate(a)} rad/s)`);
const mean = (values) => values.reduce((sum, x) => sum + x) / values.length;
const above = (values) => values.map((x) => x - mean(values));
const within = (x, last) => Math.max(0, Math.min(x, last));
const nearest = (far) => far.indexOf(Math.min(...far));
const kind = (x) => (x === removed ? "removed" : x.weight > 0 ? "for" : "against");
const set = (node, values) => Object.entries(values).forEach(([key, x]) => node.setAttribute(key, x)) || node;
const say = (text) => $("hint").textContent === text || ($("hint").textContent = text); // read aloud once
const onShow = () => (learning() ? place : { ...episode.choice, t, actions: episode.actions });
const writeAddress = () => history.replaceState(null, "", `#${new URLSearchParams(onShow())}`);
const fill = (id, all, now) => $(id).replaceChildren(...all.map((x) => new Option(x, x, false, x === now)));
const create = (kind, values) => Object.assign(document.createElement(kind), values);
const addButton = (parent, textContent, action) =>
  parent.appendChild(create("button", { textContent, onclick: () => attempt(action) }));
const drawTime = (max, value, words) => // where the range below stands, in an episode or in a training
  Object.assign($("time"), { max, value, ariaValueText: ($("clock").textContent = words) });
const pointed = ({ clientX, clientY }, map) => // where on a map the pointer is, in m; y is downwards
  new DOMPoint(clientX, clientY).matrixTransform(map.getScreenCTM().inverse());

// -------------------------------------------------- the server
async function post(path, content) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(content) });
  if (answer.ok) return answer.json();
  throw new Error((await answer.text()).trim());
}
const ask = (path, { world, weights, seed }, more) => post(path, { world, weights, seed, ...more });
const askNow = (path) => ask(path, episode.choice, { actions: episode.actions, time: String(t) });

// Fly these actions, then let the pilot fly `more` steps, and add what is not known yet.
async function extend(to, actions, more = 0, pilot = "network") {
  const since = String(to.moments.length);
  const answer = await ask("/fly", to.choice, { actions, pilot, more: String(more), since });
  answer.moments = [...to.moments, ...answer.moments];
  return Object.assign(to, answer, { actions: answer.record.actions });
}
async function attempt(action) { // Whether it went well. What fails is told in a line.
  try {
    await action();
    return true;
  } catch (error) {
    if (playing) pause();
    say(error instanceof TypeError ? `The server does not answer: ${error.message}` : error.message);
  }
}

// -------------------------------------------------- episodes
async function begin(actions, moment) { // another choice drops what this one waits for
  const [choice, away] = [chosen, learning()];
  release();
  pause();
  if (!/^\d{1,18}$/.test(choice.seed)) throw Error("The forest is a whole number of at most 18 digits.");
  const found = await extend({ choice, moments: [] }, actions);
  if (choice !== chosen) return;
  [episode, ghost, plain] = [found, null, null];
  if (away) setView(false); // not sooner, because the old flight would be on show
  drawForest();
  setReasons(null);
  show(Math.min(moment || 0, end()));
  help();
  if (!byHand() && moment === null && !learning()) play();
  while (!byHand() && !recorded() && !over()) {
    await extend(found, found.actions, 25, choice.pilot);
    if (choice !== chosen) return;
    show(playing || t >= moment ? t : Math.min(moment, end()));
  }
  if (choice.pilot === "network") return;
  const other = await extend({ choice, label: "network", moments: [] }, "", world().max_steps);
  if (choice !== chosen) return;
  [plain, ghost] = [other, ghost || other];
  draw();
}
function help() { // what one can do now
  if (learning()) say(`${TAP} a way to fly that episode, or a curve to go there.`);
  else if (!episode) return;
  else if (playing && recorded()) say(`${chosen.training}, ${who()}. Learning goes back to all episodes.`);
  else if (playing) say(steers() ? `Hold ${ARROWS} to turn harder. ${STOP} pauses.` : "");
  else if (!steers()) say(`Press ${GO}, or drag the time line. ${TAP} a trunk or bar to ask. Or take over.`);
  else if (t) say(`You have the controls: ${ARROWS} fly on from here, ${SPACE} flies straight on.`);
  else say(`Press ${ARROWS} to take off. Hold to turn harder. The network flies along as a ghost.`);
}
async function steer() {
  if (underway) return;
  const [mine, before, start] = [episode, asked, performance.now()];
  underway = extend(mine, mine.actions + turn()).finally(() => (underway = null));
  await underway;
  if (mine !== episode) return;
  show(end());
  requestAnimationFrame(() => performance.measure("step to frame", { start }));
  if (before === asked) help();
  if (!over()) return;
  pause();
  say(`You: ${ENDS[mine.record.outcome]}. Fly Again, or the Next. Or drag the time line, and ask why.`);
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
  const no = t === end() && over() ? "The flight ends here. Press Again, or go back and press Take over here."
    : "Press Take over here to steer from this moment.";
  if (!steers()) return (pause(), say(no)); // what was asked is dropped
  stick.tapped[side] = 1;
  play();
}

// As it was until moment `from`, then another turn for some steps, then the network to the end.
async function otherwise(from, action, steps) {
  const [at, label] = [clock(from), `what if ${rate(action)} at ${clock(from)}`];
  const words = `The dashed path ${inWords(action)} at ${at} for ${clock(steps)}, then the network flies on`;
  const other = { ...episode, from, at, label, words, whole: true, record: { outcome: "" } };
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
  ghost?.words === other.words ? clear("ghost") : compare(other); // the same bar again takes it away
}
function compare(other, known = "") {
  ghost = other;
  answers.push("ghost");
  show(other.from);
  say(`${known}${other.words}: ${result(other.record)}. Esc, or the same bar, takes it away.`);
}
function clear(name) { // an answer: the latest, if none is named
  pause();
  const there = { inside, ghost: ghost !== plain, why: reasons, trunk: removed };
  const last = name || answers.findLast((x) => there[x]);
  [inside, ghost] = [inside && last !== "inside", last === "ghost" ? plain : ghost];
  if (last === "why" || last === "trunk") setReasons(last === "trunk" ? reasons : null);
  draw();
}

// The last moment at which another turn saves the episode. It is flown, so the answer is exact.
async function wentWrong() {
  const [me, steps] = [await settle(), Math.round(0.5 / world().dt)];
  if (me !== asked) return;
  if (!over()) return say("This episode is not over. Fly it to its end first.");
  if (crossed(episode)) return say(`Nothing went wrong: the drone ${ENDS[episode.record.outcome]}.`);
  let from = end();
  while (from >= steps && from > end() - 10 * steps) {
    from -= steps;
    say(`The network tries whether another turn at ${clock(from)} would have saved it.`);
    for (const action of [2 * straight(), straight(), 0]) {
      const other = await otherwise(from, action, steps);
      if (me !== asked) return;
      if (crossed(other)) return compare(other, `Of each half second, the last way out was at ${other.at}. `);
    }
  }
  const nothing = `Nothing saves it: left, straight on and right for 0.5 s were tried at each half second
    from ${clock(from)} on.`;
  if (!isQ()) return say(nothing);
  const best = episode.moments.map(({ q }) => Math.max(...q));
  show(Math.max(nearest(best.slice(1, -1).map((x, i) => x - best[i])), 0));
  say(`${nothing} After ${clock(t)} the greatest Q falls most.`);
}

// -------------------------------------------------- why
async function why(trunk = null) {
  const [me, moment] = [await settle(), t];
  const answer = reasons || (await askNow("/why"));
  if (me !== asked || moment !== t) return;
  answers.push(...(reasons ? [] : ["why"]), "trunk");
  setReasons(answer, removed && removed.trunk === trunk ? null : trunk);
  draw();
  const seen = trunk === null || answer.without.some((x) => x.trunk === trunk);
  if (!seen) say("That is in none of the four frames: without it nothing would change.");
}
function setReasons(answer, trunk = null) {
  const things = answer ? answer.without.slice(0, SHOWN) : [];
  [reasons, removed] = [answer, answer?.without.find((x) => x.trunk === trunk) || null];
  const lead = answer && signed(above(answer.before)[answer.chosen]).slice(1);
  $("answer").innerHTML = !answer ? "" : `<p>The network ${inWords(answer.chosen)}: this ${score()} is ${lead}
    above the mean of the nine. What if a trunk were gone? <b class="for">+ this lead would fall by so much:
    it speaks for this way.</b> <b class="against">− it would rise: against.</b></p><div class="row"></div>`;
  for (const x of things) {
    const button = addButton($("answer").lastChild, `${x.name} ${signed(x.weight)}`, () => why(x.trunk));
    set(button, { class: x.weight > 0 ? "for" : "against", "aria-pressed": x === removed });
  }
  const outline = (x, [left, top, width, height]) =>
    `<rect class="${kind(x)}" x="${left}" y="${top}" width="${width}" height="${height}"/>`;
  $("marks").innerHTML = things.filter((x) => x.box.length).map((x) => outline(x, x.box)).join("");
  drawTrunks();
}
function clickMap(event) {
  const { x: px, y: py } = pointed(event, $("map"));
  const things = [...episode.trunks, ...(world().beacon ? [[world().length, 0]] : [])];
  const far = things.map(([x, y]) => Math.hypot(x - px, y + py));
  const trunk = nearest(far) < episode.trunks.length ? nearest(far) : -1; // -1: the goal's pole
  if (Math.min(...far) < NEAR) attempt(() => why(trunk));
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
  show(within(moment, end()));
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
function drawGround(map, { length, width, back, goal_radius }) { // the empty forest of a map
  set(map, { viewBox: `${-back - 1} ${-width / 2 - 1} ${length + back + 5} ${width + 2}` });
  set(map.querySelector(".ground"), { x: -back, y: -width / 2, width: length + back, height: width });
  set(map.querySelector(".goal"), { cx: length, r: goal_radius });
}
function drawForest() {
  const { length, beacon, view } = world();
  drawGround($("map"), world());
  set($("pole"), { cx: length, r: beacon ? 0.7 : 0 });
  const edge = view * Math.tan(options.half_view);
  set($("view"), { d: `M0 0L${view} ${edge}V${-edge}Z` });
  $("trunks").innerHTML = episode.trunks.map(([x, y]) => `<circle cx="${x}" cy="${-y}"/>`).join("");
}
function draw() {
  if (learning()) return;
  const frame = (ago) => episode.moments[Math.max(t - ago, 0)].frame;
  paint($("seen"), removed ? removed.frame : frame(0));
  [...$("look").children].forEach((canvas, i) => paint(canvas, frame(3 - i)));
  drawMap();
  drawBars();
  drawLines("curves", VALUES, episode.moments, (_, i) => i / Math.max(end(), 1), t);
  drawTable();
  attempt(drawInside);
  drawTime(end(), t, `${clock(t)} of ${clock(end())}`);
  const last = t === end() && over() ? result(episode.record) : "";
  $("banner").textContent = removed ? `without: ${removed.name} (${touch ? "tap it" : "Esc"}: back)` : last;
}
function paint(canvas, frame) {
  const grey = atob(frame);
  canvas.width = canvas.height = Math.sqrt(grey.length);
  const image = new ImageData(canvas.width, canvas.height);
  const colours = new Uint32Array(image.data.buffer);
  for (let i = 0; i < grey.length; i++) colours[i] = 0xff000000 + 0x10101 * grey.charCodeAt(i);
  canvas.getContext("2d").putImageData(image, 0, 0);
}
async function drawInside() { // what the filters of the first layer find; each moment is asked for once
  // A recorded way shows it only with the weights of its own training.
  const here = !recorded() || chosen.weights === chosen.training.replace(/^results\//, "");
  const [moment, open] = [episode.moments[t], here && inside];
  [$("look").disabled, $("look").ariaExpanded, $("inside").hidden] = [!here, open, !open];
  $("place-word").textContent = open ? "What the first layer finds" : "Where it is";
  if (!open || (looking && !moment.maps)) return;
  if (moment.maps) return $("maps").childNodes.forEach((canvas, i) => paint(canvas, moment.maps[i]));
  looking = askNow("/look").finally(() => (looking = null));
  moment.maps = (await looking).maps;
  if (!$("maps").firstChild) $("maps").innerHTML = "<canvas></canvas>".repeat(moment.maps.length);
  return drawInside(); // the flight may have gone on
}
function drawMap() {
  const path = (id, moments) =>
    set($(id), { points: moments.map(({ pose: [x, y] }) => `${x.toFixed(2)},${(-y).toFixed(2)}`).join(" ") });
  const place = (id, { pose: [x, y, heading] }) =>
    set($(id), { transform: `translate(${x} ${-y}) rotate(${(-heading * 180) / Math.PI})` });
  for (const id of ["drone", "view"]) place(id, episode.moments[t]);
  path("whole-path", episode.moments);
  path("path", episode.moments.slice(0, t + 1));
  const { moments, label, whole } = ghost || { moments: [{ pose: [-99, 0, 0] }], label: "" };
  // Who flies by hand should not see where the ghost is going to turn.
  path("ghost-path", byHand() && !over() && !whole ? moments.slice(0, t + 1) : moments);
  place("ghost", moments[Math.min(t, moments.length - 1)]);
  [$("main-name").textContent, $("ghost-name").textContent] = [who(), label];
  $("ghost-mark").hidden = !ghost;
}
function drawTrunks() {
  const found = new Map((reasons ? reasons.without : []).map((x) => [x.trunk, x]));
  const most = Math.max(...[...found.values()].map((x) => Math.abs(x.weight)), 1e-9);
  const colour = (node, x, r) => {
    const part = x ? Math.abs(x.weight) / most : 0;
    set(node, { class: x ? kind(x) : node.id, r: r * (1 + part), "fill-opacity": x ? 0.3 + 0.7 * part : 1 });
  };
  colour($("goal"), found.get(-1), world().goal_radius);
  [...$("trunks").children].forEach((circle, i) => colour(circle, found.get(i), 1.2 * world().trunk_radius));
}
function drawBars() {
  const [{ q }, { q: other }] = [episode.moments[t], removed || episode.moments[t]];
  const [own, without] = [above(q), above(other)];
  const reach = 2 ** Math.ceil(Math.log2(Math.max(0.1, ...[...own, ...without].map(Math.abs))));
  $("scale").textContent = `line: the mean, ${number(mean(q))}; top edge: ${reach} more`;
  const bar = (x, kind) =>
    `<rect class="${kind}" y="${-Math.max(x, 0) / reach}" width="1" height="${Math.abs(x) / reach}"/>`;
  [...$("bars").children].reverse().forEach((button, a) => {
    button.ariaLabel = `${rate(a)} radians a second: ${score()} ${number(q[a])}. What if it steered so?`;
    button.classList.toggle("best", q[a] === Math.max(...q));
    button.classList.toggle("flown", episode.actions[t] === String(a));
    button.innerHTML = `<span>${number(q[a])}</span><svg viewBox="0 -1 1 2" preserveAspectRatio="none">
      <path d="M-9 0H9"/>${bar(own[a], "own")}${removed ? bar(without[a], "other") : ""}</svg>
      <span class="rate">${rate(a)}</span><span class="after">${removed ? number(other[a]) : ""}</span>`;
  });
}

// Values of all rows as lines. at: where a row is, 0 to 1; now: the one on show; band: [least, greatest].
function drawLines(id, names, rows, at, now, band = []) {
  const line = ([key, name]) => {
    const factor = name.endsWith("%") ? 100 : 1;
    const points = rows.map((row, i) => [at(row, i), factor * row[key]]);
    const [least, most] = [0, 1].map((i) => band.map((row) => [at(row), factor * row[key][i]]));
    const ys = [...points, ...least, ...most].map(([, y]) => y);
    const [low, high] = [Math.min(0, ...ys), Math.max(1, ...ys)];
    const place = ([x, y]) => `${(100 * x).toFixed(2)} ${(30 - (30 * (y - low)) / (high - low)).toFixed(2)}`;
    const path = (kind, line) => `<path class="${kind}" d="M${line.map(place).join("L")}"/>`;
    const [x, y] = points[now];
    return `<div class="curve"><span>${name} <b>${number(y)}</b></span><svg viewBox="0 0 100 30" fill="none"
      preserveAspectRatio="none" stroke-width="1.5" aria-hidden="true">
      ${band.length ? path("band", [...least, ...most.reverse()]) : ""}${path("line", points)}
      ${path("cursor", [[x, low], [x, high]])}</svg>
      <small><i>${number(high)}</i><i>${number(low)}</i></small></div>`;
  };
  $(id).innerHTML = Object.entries(names).map(line).join("");
}
function drawTable() {
  const known = (f) => ENDS[f.record.outcome] && (over() || f.whole);
  const row = (f) => `<tr><th>${f.label}</th><td>${known(f) ? result(f.record) : "…"}</td></tr>`;
  $("table").innerHTML = row({ ...episode, label: who() }) + (ghost ? row(ghost) : "");
}

// -------------------------------------------------- choices, address, file
async function choose(change, actions = "", moment = null) {
  const after = (chosen = { ...chosen, ...change });
  if (recorded() && !actions) chosen.pilot = "network"; // in another forest
  chosen.weights ||= weightsOf(chosen.world)[0];
  drawChoices();
  const well = await attempt(() => begin(actions, moment));
  if (!well && episode && chosen === after) chosen = episode.choice;
  drawChoices();
  return well;
}
function drawChoices() {
  for (const button of document.querySelectorAll("#pilots button, #worlds button")) {
    const name = button.textContent;
    set(button, { "aria-pressed": name === chosen.pilot || name === chosen.world });
    button.disabled = name in options.worlds && !weightsOf(name).length;
  }
  fill("weights", weightsOf(chosen.world), chosen.weights);
  [$("seed").value, $("stick").hidden] = [chosen.seed, !byHand()];
  $("mind-word").textContent = `What ${chosen.weights} thinks`;
  $("meaning").textContent = isQ() ? `Q: the return that ${chosen.weights} expects after each turn, in rad/s.`
    : "Scores: what the expert that it imitates would say of each turn, in rad/s (only differences count).";
}
async function restore() {
  const told = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const { training, step, weights, seed = "1" } = told;
  const first = { pilot: "you", world: options.world, seed, weights };
  if (options.pilots.includes(told.pilot)) first.pilot = told.pilot;
  if (weightsOf(told.world).length) first.world = told.world;
  if (training) place = { training, step };
  if (told.pilot === RECORDED && training && step > 0) Object.assign(first, place, { pilot: RECORDED });
  if (!episode) chosen = first;
  if (training && !told.seed) return attempt(openLearning);
  if (await choose(first, told.actions, Math.trunc(Math.abs(Number(told.t))) || 0) || episode) return;
  const wrong = $("hint").textContent;
  if (await choose({ seed: "1", weights: "" })) say(wrong);
}
async function share() {
  pause();
  writeAddress();
  const how = await navigator.clipboard.writeText(location.href).then(() => "Copied", () => "Address bar");
  const what = learning() ? "this training at this validation" : "this episode at this moment";
  say(`${how}: ${what}. It opens where a cockpit runs at ${location.host}.`);
}
function save() {
  pause();
  const mine = [...done.values()].filter((f) => f.world === chosen.world && f.seed < options.train_end);
  const [others, { beacon, camera }] = [done.size - mine.length, world()];
  const left = others ? ` Left out: ${others} (another world, or a test forest: 1,000,000,000 and up).` : "";
  if (!mine.length) return say(`Nothing to save yet: fly a forest of this world to its end by hand.${left}`);
  const pilots = { you: { episodes: mine.map(({ world, ...record }) => record) } };
  const file = new Blob([JSON.stringify({ beacon, camera, pilots })], { type: "application/json" });
  create("a", { href: URL.createObjectURL(file), download: "episodes.json" }).click();
  const flags = (beacon ? " --beacon" : "") + (camera === "grey" ? "" : ` --camera ${camera}`);
  say(`Episodes in the file episodes.json: ${mine.length}.${left} To learn from them: .venv/bin/python -m
    extras.lessons.demonstrations train --demos FILE --demo-pilot you${flags}`);
}

// -------------------------------------------------- keys and buttons
const go = (by) => (learning() ? goTo(at + by) : stepTo(t + by));
const actions = {
  play: () => (playing ? pause() : play()), back: () => go(-1), step: () => go(1),
  next: () => choose({ seed: String(BigInt(chosen.seed) + 1n) }),
  again: () => choose({}, recorded() ? episode.actions : ""),
  random: () => choose({ seed: String(Math.floor(Math.random() * options.train_end)) }),
  take: () => choose({ pilot: "you" }, episode.actions.slice(0, over() ? Math.min(t, end() - 1) : t), t),
  look: () => draw((inside = !inside) && answers.push("inside")), clear: () => clear(),
  why: () => why(), wrong: wentWrong, learning: () => openLearning(), flying: openFlying, share, save,
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
  if (action) attempt(action);
  else if (!event.repeat) hold(side, true);
}
function listen() {
  const on = (id, event, action) => $(id).addEventListener(event, action);
  for (const type of ["keydown", "keyup"]) document.addEventListener(type, key);
  window.addEventListener("blur", release);
  window.addEventListener("hashchange", restore);
  document.addEventListener("visibilitychange", () => document.hidden && (release(), pause()));
  // What was clicked by a mouse, or chosen, would keep the focus, and take the keys that steer.
  document.addEventListener("click", (e) => e.detail && e.target.closest("button, [type=range]")?.blur());
  document.addEventListener("change", ({ target }) => target.matches("select, #seed") && target.blur());
  const hands = ["pointerdown", "pointerup", "pointerleave", "pointercancel"];
  for (const side of ["left", "right"])
    for (const name of hands) on(side, name, () => hold(side, name === "pointerdown"));
  const act = (action) => (episode || learning()) && attempt(action);
  for (const [name, action] of Object.entries(actions)) if ($(name)) on(name, "click", () => act(action));
  const offer = (id, name, change) => (addButton($(id), name, () => choose(change)).title = MEANING[name]);
  for (const pilot of options.pilots) offer("pilots", pilot, { pilot });
  for (const world of Object.keys(options.worlds)) offer("worlds", world, { world, weights: "" });
  for (let a = options.worlds.plain.num_actions; a--; ) addButton($("bars"), "", () => whatIf(a)); // 8 to 0
  listenLearning(on);
  on("map", "click", clickMap);
  on("time", "input", () => go(Number($("time").value) - (learning() ? at : t)));
  on("seed", "change", () => choose({ seed: $("seed").value.trim() }));
  on("weights", "change", () => choose({ weights: $("weights").value }, recorded() ? episode.actions : ""));
  for (const word of document.querySelectorAll(".note i")) word.textContent = TAP;
}

attempt(async () => {
  options = await post("/options", {});
  listen();
  await restore();
  // Not at each change, because browsers complain if the address changes many times a second.
  setInterval(() => (learning() ? training : episode) && writeAddress(), 500);
});
