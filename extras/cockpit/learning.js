"use strict";
// The view "Learning": a training, validation by validation. The ways of its episodes follow from their actions alone.

const CURVES = { return: ["return", 1], steps: ["length, steps", 1], crossed: ["crossed, %", 100], crash: ["hit a trunk, %", 100] };
let training = null; // on show: name, world, weights, validations, and the band of how many others
let [at, named] = [0, -1]; // the validation on show; the episode that the pointer or the keys are at
let place = {}; // training and step, as the address tells them
let lost = false; // whether the server left the last question for more without an answer

const learning = () => document.body.classList.contains("learning");
const now = () => training?.validations[at];
const lastStep = () => Math.max(training.validations.at(-1).step, training.band.at(-1)?.step[0] || 0);

const setView = (toLearning) => (document.body.classList.toggle("learning", toLearning), pause());

const openFlying = () => (setView(false), episode ? draw() : choose({}));

// Show a training at the step of `place`, or else the latest run, and its last validation.
async function openLearning(name = place.training) {
  const { step } = place;
  setView(true);
  const found = await post("/trainings", {});
  if (!found.length) throw new Error("There is no training with validation episodes here. This begins one: python deepflight.py train");
  const known = found.find((x) => x.name === name);
  const mine = (training = { ...(known || found[0]), validations: [] });
  $("training").replaceChildren(...found.map((x) => new Option(x.name, x.name, false, x.name === mine.name)));
  for (const id of ["ways-word", "all-ways", "ends", "progress", "band", "count", "named"]) $(id).replaceChildren();
  drawGround($("ways"), options.worlds[mine.world]);
  await learnMore();
  if (mine !== training) return;
  const there = mine.validations.findIndex((x) => x.step === Number(step));
  goTo(there < 0 ? Infinity : there);
  if (name && !known) say(`There is no training ${name} here.`);
}

// Ask for the validations since. Who looks at the last one goes on to the next.
async function learnMore() {
  const [mine, since] = [training, training.validations.length];
  const { validations, count, ...band } = await post("/training", { name: mine.name, since: String(since) });
  if (mine !== training || since !== mine.validations.length) return;
  if (count < since) return openLearning(); // it has begun anew
  Object.assign(mine, band).validations.push(...validations);
  if (validations.length) goTo(at === since - 1 ? Infinity : at);
}

async function poll() {
  if (!learning() || !training || document.hidden) return;
  const well = await attempt(learnMore);
  if (well && lost) help();
  lost = !well;
}

function goTo(validation) {
  if (!training?.validations.length) return say("There is no validation yet.");
  at = Math.max(Math.min(validation, training.validations.length - 1), 0);
  place = { training: training.name, step: now().step };
  drawProgress();
  drawWays();
}

async function flyEpisode(i) {
  if (!now()?.episodes[i]) return;
  const [{ seed, actions }, { world, weights }, from] = [now().episodes[i], training, place];
  options = await post("/options", {}); // the weights of a running training may be younger than the page
  setView(false);
  await choose({ ...from, pilot: RECORDED, world, weights, seed: String(seed) }, actions);
}

// -------------------------------------------------- drawing
// As env.py does it: turn, then fly straight.
function wayOf({ actions }) {
  const { speed, dt, yaw_rate, num_actions } = options.worlds[training.world];
  let [x, y, heading] = [0, 0, 0];
  const step = (action) => {
    heading += yaw_rate * ((2 * action) / (num_actions - 1) - 1) * dt;
    return [(x += speed * dt * Math.cos(heading)), (y += speed * dt * Math.sin(heading))];
  };
  return [[0, 0], ...Array.from(actions, step)];
}

const cm = (x) => Math.round(100 * x) / 100; // toFixed is slow
// Each third point is enough for the eye, and halves the time to draw them all.
const outlineOf = (e) => (e.outline ||= `M${e.way.filter((_, i) => i % 3 === 0 || i === e.way.length - 1).map(([x, y]) => `${cm(x)} ${cm(-y)}`).join("L")}`);
const described = (e) => `forest ${e.seed}: ${ENDS[e.outcome]} after ${clock(e.steps)}, return ${number(e.return)}`;

function drawWays() {
  const [{ episodes, minutes }, ways, when] = [now(), $("all-ways"), `after ${thousands(now().step)} steps`];
  $("ways-word").textContent = `${episodes.length} validation episodes ${when}, ${number(minutes)} minutes`;
  if (ways.children.length !== episodes.length) ways.replaceChildren(...episodes.map(() => svg("path")));
  episodes.forEach((e, i) => {
    e.way ||= wayOf(e);
    // The Tab key finds one of them, and ↑ and ↓ lead to the others.
    set(ways.children[i], { d: outlineOf(e), "data-end": e.outcome, role: "button", tabindex: i ? -1 : 0, "aria-label": described(e) });
  });
  const counts = Object.keys(ENDS).map((end) => [end, episodes.filter((e) => e.outcome === end).length]);
  $("ends").innerHTML = counts.map(([end, n]) => (n ? `<span data-end="${end}"><b class="swatch" aria-hidden="true">■</b> ${ENDS[end]} ${n}</span>` : "")).join("");
  [$("validation").max, $("validation").value] = [training.validations.length - 1, at];
  set($("validation"), { "aria-valuetext": when });
  $("count").textContent = `${at + 1} of ${training.validations.length}`;
  nameWay(named);
}

function drawProgress() {
  const { validations, band, others } = training;
  const one = ([key, [title, factor]]) => {
    const line = validations.map((row) => [row.step / lastStep(), factor * row[key]]);
    const around = band.map((row) => [row.step[0] / lastStep(), ...row[key].map((x) => factor * x)]);
    return curve(title, factor * now()[key], line, now().step / lastStep(), around);
  };
  $("progress").innerHTML = Object.entries(CURVES).map(one).join("");
  $("band").textContent = `From step 0 to ${thousands(lastStep())}. ` + (!others ? "No other committed training has these settings." :
    `Band: from least to greatest of the committed trainings that differ in the seed alone (${others}).
    By chance, ${Math.round(200 / (others + 1))} % of another seed's validations lie outside it.`);
}

// Tell which episode it is; -1 is none.
function nameWay(i) {
  const e = now()?.episodes[(named = i)];
  $("named").textContent = e ? described(e) : "Point at a way, and it says which episode that is.";
  set($("one-way"), { d: e ? outlineOf(e) : "M0 0", "data-end": e ? e.outcome : "" });
}

// -------------------------------------------------- pointer and keys
function pointedAt(event) {
  const { x, y } = pointed(event, $("ways"));
  const far = (now()?.episodes || []).map(({ way }) => Math.min(...way.map((p) => Math.hypot(p[0] - x, p[1] + y))));
  return Math.min(...far) < NEAR ? far.indexOf(Math.min(...far)) : -1;
}

function clickCurve(event) {
  const { left, width } = event.target.closest("svg")?.getBoundingClientRect() || {};
  if (!width) return;
  const far = training.validations.map(({ step }) => Math.abs(step / lastStep() - (event.clientX - left) / width));
  goTo(far.indexOf(Math.min(...far)));
}

function learningKey(event) {
  const ways = [...$("all-ways").children];
  const i = ways.indexOf(event.target);
  const keys = { ArrowLeft: actions.sooner, ArrowRight: actions.later, ArrowDown: () => ways.at(i + 1)?.focus(), ArrowUp: () => ways.at(i - 1)?.focus() };
  if (i >= 0) keys.Enter = keys[" "] = () => attempt(() => flyEpisode(i));
  if (!keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
}

function listenLearning(on) {
  on("ways", "pointermove", (event) => nameWay(pointedAt(event)));
  on("ways", "pointerleave", () => nameWay(-1));
  on("all-ways", "focusin", (event) => nameWay([...$("all-ways").children].indexOf(event.target)));
  on("ways", "click", (event) => attempt(() => flyEpisode(pointedAt(event))));
  on("progress", "click", clickCurve);
  on("validation", "input", () => goTo(Number($("validation").value)));
  on("training", "change", () => attempt(() => openLearning($("training").value)));
  setInterval(poll, 2000);
}
