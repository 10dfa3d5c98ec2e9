"use strict";
// The view "Learning": a training, validation by validation.

const CURVES = { return: "return", steps: "length, steps", crossed: "crossed, %", crash: "hit a trunk, %" };
let training = null; // on show: name, world, weights, validations, and the band of how many others
let [at, named] = [0, -1]; // the validation on show; the episode that the pointer or the keys are at
let place = {}; // training and step, as the address tells them
let lost = false; // whether the server left the last question for more without an answer

const learning = () => document.body.classList.contains("learning");
const now = () => training?.validations[at];
const lastStep = () => Math.max(training.validations.at(-1).step, training.band.at(-1)?.step[0] || 0);
const setView = (toLearning) => (document.body.classList.toggle("learning", toLearning), pause());
const openFlying = () => (episode ? (setView(false), draw()) : choose({}));

// Show a training, or else the server's first, at the step of its address, or else at its first validation.
async function openLearning(name = place.training) {
  const step = name === place.training && place.step;
  setView(true);
  const found = await post("/trainings", {});
  if (!found.length) throw Error("There is no training here. This begins one: python deepflight.py train");
  const known = found.find((x) => x.name === name);
  const mine = (training = { ...(known || found[0]), validations: [] });
  fill("training", found.map((x) => x.name), mine.name);
  "ways-word all-ways ends progress band clock named".split(" ").forEach((id) => $(id).replaceChildren());
  drawGround($("ways"), options.worlds[mine.world]);
  await learnMore();
  if (mine !== training) return;
  goTo(Math.max(mine.validations.findIndex((x) => x.step === Number(step)), 0));
  if (name && !known) say(`There is no training ${name} here.`);
}

async function learnMore() { // Ask for the validations since. Who looks at the last one goes on to the next.
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
  at = within(validation, training.validations.length - 1);
  place = { training: training.name, step: now().step };
  drawProgress();
  drawWays();
}
async function flyEpisode(i) {
  if (!now()?.episodes[i]) return;
  const [{ seed, actions }, { world, weights }, from] = [now().episodes[i], training, place];
  options = await post("/options", {}); // the weights of a running training may be younger than the page
  await choose({ ...from, pilot: RECORDED, world, weights, seed: String(seed) }, actions);
}

// -------------------------------------------------- drawing
function wayOf({ actions }) { // As env.py does it: turn, then fly straight
  const { speed, dt, yaw_rate, num_actions } = options.worlds[training.world];
  let [x, y, heading] = [0, 0, 0];
  const step = (action) => {
    heading += yaw_rate * ((2 * action) / (num_actions - 1) - 1) * dt;
    return [(x += speed * dt * Math.cos(heading)), (y += speed * dt * Math.sin(heading))];
  };
  return [[0, 0], ...Array.from(actions, step)];
}
function outlineOf(e) { // each third point is enough for the eye, and halves the time to draw them all
  const cm = (x) => Math.round(100 * x) / 100; // toFixed is slow
  const some = (way) => way.filter((_, i) => i % 3 === 0 || i === way.length - 1);
  return (e.outline ||= `M${some(e.way).map(([x, y]) => `${cm(x)} ${cm(-y)}`).join("L")}`);
}
const described = (e) => `forest ${e.seed}: ${result(e)}`;
function drawWays() {
  const [{ episodes, minutes, step }, ways, { length }] = [now(), $("all-ways"), training.validations];
  const when = `after ${thousands(step)} steps`;
  $("ways-word").textContent = `${episodes.length} validation episodes ${when}, ${number(minutes)} minutes`;
  if (ways.children.length !== episodes.length) ways.innerHTML = "<path/>".repeat(episodes.length);
  episodes.forEach((e, i) => {
    e.way ||= wayOf(e);
    // The Tab key finds one of them, and ↑ and ↓ lead to the others.
    const reach = { role: "button", tabindex: i ? -1 : 0, "aria-label": described(e) };
    set(ways.children[i], { d: outlineOf(e), "data-end": e.outcome, ...reach });
  });
  const counts = Object.keys(ENDS).map((end) => [end, episodes.filter((e) => e.outcome === end).length]);
  $("ends").innerHTML = counts.filter(([, n]) => n).map(([end, n]) =>
    `<span data-end="${end}"><b class="swatch" aria-hidden="true">■</b> ${ENDS[end]} ${n}</span>`).join("");
  drawTime(length - 1, at, `${at + 1} of ${length}`);
  nameWay(named);
}
function drawProgress() {
  const { validations, band, others } = training;
  const share = ({ step }) => (step[0] ?? step) / lastStep(); // of the band: least and greatest
  drawLines("progress", CURVES, validations, share, at, band);
  const words = others ? `Grey: from the lowest to the highest of the shipped trainings that differ only in
    their seed (${others}). Expect ${Math.round(200 / (others + 1))} % of a further seed's points outside it.`
    : "No other shipped training has these settings.";
  $("band").textContent = `From step 0 to ${thousands(lastStep())}. ${words}`;
}
function nameWay(i) { // tell which episode it is; -1 is none
  const e = now()?.episodes[(named = i)];
  $("named").textContent = e ? described(e) : touch ? "" : "Point at a way to see which episode it is.";
  set($("one-way"), { d: e ? outlineOf(e) : "M0 0", "data-end": e ? e.outcome : "" });
}

// -------------------------------------------------- pointer and keys
const focused = () => [...$("all-ways").children].indexOf(document.activeElement);
function pointedAt(event) {
  const { x, y } = pointed(event, $("ways"));
  const off = ({ way }) => Math.min(...way.map((p) => Math.hypot(p[0] - x, p[1] + y)));
  const far = (now()?.episodes || []).map(off);
  return Math.min(...far) < NEAR ? nearest(far) : focused();
}
function clickCurve(event) {
  const { left, width } = event.target.closest("svg")?.getBoundingClientRect() || {};
  const share = (event.clientX - left) / width;
  if (width) goTo(nearest(training.validations.map(({ step }) => Math.abs(step / lastStep() - share))));
}
function learningKey(event) {
  const fly = named >= 0 && !event.target.matches("button") && (() => attempt(() => flyEpisode(named)));
  const nameBy = (by) => ([...$("all-ways").children].at(named + by)?.focus(), nameWay(focused()));
  const keys = { ArrowLeft: actions.back, ArrowRight: actions.step, Enter: fly, " ": fly,
    ArrowDown: () => nameBy(1), ArrowUp: () => nameBy(-1) };
  if (!keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
}
function listenLearning(on) {
  on("ways", "pointermove", (event) => nameWay(pointedAt(event)));
  on("ways", "pointerleave", () => nameWay(focused()));
  on("all-ways", "focusin", () => nameWay(focused()));
  on("ways", "click", (event) => attempt(() => flyEpisode(pointedAt(event))));
  on("progress", "click", clickCurve);
  on("training", "change", () => attempt(() => openLearning($("training").value)));
  setInterval(poll, 2000);
}
