"use strict";
// The view "Learning": a training, validation by validation. It shows the ways of all episodes of
// one, which follow from their actions alone, and four curves over the whole training.

const CURVES = { return: ["return", 1], steps: ["length, steps", 1], crossed: ["crossed, %", 100], crash: ["hit a trunk, %", 100] };
let training = null; // on show: name, world, weights, validations, and the band of how many others
let [at, named] = [0, -1]; // the validation on show; the episode that the pointer or the keys are at
let place = {}; // training and step, as the address tells them
let lost = false; // whether the server left the last question for more without an answer

const learning = () => document.body.classList.contains("learning");
const now = () => training?.validations[at];
const lastStep = () => Math.max(training.validations.at(-1).step, training.band.at(-1)?.step[0] || 0);

function setView(toLearning) {
  document.body.classList.toggle("learning", toLearning);
  pause();
}

function openFlying() {
  setView(false);
  return episode ? draw() : choose({});
}

// Show the training and the step of `place`, or the latest run at its last validation.
async function openLearning() {
  const { training: name, step } = place;
  setView(true);
  const found = await post("/trainings", {});
  if (!found.length) throw new Error("There is no training with validation episodes here. This begins one: python deepflight.py train");
  const known = found.find((x) => x.name === name);
  training = { ...(known || found[0]), validations: [] };
  const select = found.map((x) => new Option(x.name, x.name, false, x.name === training.name));
  $("training").replaceChildren(...select);
  for (const id of ["ways-word", "all-ways", "ends", "progress", "band", "count", "named"]) $(id).replaceChildren();
  drawGround($("ways"), options.worlds[training.world]);
  await learnMore();
  const there = training.validations.findIndex((x) => x.step === Number(step));
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
  at = Math.max(Math.min(validation, training.validations.length - 1), 0);
  if (!now()) return say(`${training.name} has no validation yet.`);
  place = { training: training.name, step: now().step };
  drawProgress();
  drawWays();
}

async function flyEpisode(i) {
  const [e, { world, weights }] = [now()?.episodes[i], training];
  if (!e) return;
  options = await post("/options", {}); // the weights of a running training may be younger than the page
  setView(false);
  await choose({ ...place, pilot: RECORDED, world, weights, seed: String(e.seed) }, e.actions);
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

const outlineOf = ({ way }) => `M${way.map(([x, y]) => `${x.toFixed(2)} ${(-y).toFixed(2)}`).join("L")}`;
const described = (e) => `forest ${e.seed}: ${ENDS[e.outcome]} after ${clock(e.steps)}, return ${number(e.return)}`;

function drawWays() {
  const [{ episodes, step, minutes }, ways] = [now(), $("all-ways")];
  const when = `after ${thousands(step)} steps`;
  $("ways-word").textContent = `${episodes.length} validation episodes ${when}, ${number(minutes)} minutes`;
  const missing = Math.max(episodes.length - ways.children.length, 0);
  ways.append(...Array.from({ length: missing }, () => document.createElementNS("http://www.w3.org/2000/svg", "path")));
  [...ways.children].slice(episodes.length).forEach((path) => path.remove());
  episodes.forEach((e, i) => {
    e.way ||= wayOf(e);
    // The Tab key finds one of them, and ↑ and ↓ lead to the others.
    set(ways.children[i], { d: outlineOf(e), "data-end": e.outcome, role: "button", tabindex: i ? -1 : 0, "aria-label": described(e) });
  });
  const counts = Object.keys(ENDS).map((end) => [end, episodes.filter((e) => e.outcome === end).length]);
  $("ends").innerHTML = counts.map(([end, n]) => (n ? `<span data-end="${end}"><i class="swatch"></i> ${ENDS[end]} ${n}</span>` : "")).join("");
  [$("validation").max, $("validation").value] = [training.validations.length - 1, at];
  set($("validation"), { "aria-valuetext": when });
  $("count").textContent = `${at + 1} of ${training.validations.length}`;
  name(named);
}

function drawProgress() {
  const { validations, band, others } = training;
  const one = ([key, [title, factor]]) => {
    const line = validations.map((row) => [row.step / lastStep(), factor * row[key]]);
    const around = band.map((row) => [row.step[0] / lastStep(), ...row[key].map((x) => factor * x)]);
    return curve(title, factor * now()[key], line, now().step / lastStep(), around);
  };
  $("progress").innerHTML = Object.entries(CURVES).map(one).join("");
  const outside = `By chance alone, ${Math.round(200 / (others + 1))} % of another seed's validations lie outside it.`;
  const words = `Band: from the least to the greatest of ${others} committed trainings that differ in the seed alone. ${outside}`;
  $("band").textContent = `From step 0 to ${thousands(lastStep())}. ${others ? words : "No other committed training has these settings."}`;
}

// Tell which episode it is; -1 is none.
function name(i) {
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
  if (event.type === "keyup" || !training || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
}

function listenLearning(on) {
  on("ways", "pointermove", (event) => name(pointedAt(event)));
  on("ways", "pointerleave", () => name(-1));
  on("all-ways", "focusin", (event) => name([...$("all-ways").children].indexOf(event.target)));
  on("ways", "click", (event) => attempt(() => flyEpisode(pointedAt(event))));
  on("progress", "click", clickCurve);
  on("validation", "input", () => goTo(Number($("validation").value)));
  on("training", "change", () => {
    place.training = $("training").value;
    attempt(openLearning);
  });
  setInterval(poll, 2000);
}
