// Puts the page together: snapshots to views, buttons and keys to commands.

import { command, connect, post } from "/connection.js";
import { Cards, STATES, element, fixed, lasting, otherSet } from "/cards.js";
import { Large } from "/large.js";
import { Track, palette } from "/track.js";
import { Log, showLaps, showNumbers, showStandings } from "/lists.js";
import { Sound } from "/sound.js";
import { Analysis } from "/analysis.js";
import { SessionDialog } from "/sessions.js";

const $ = (id) => document.getElementById(id);
const press = (button, on) => button.setAttribute("aria-pressed", String(on));
let snapshot = null;
let selected = null;
let epoch = null;
let laps = { car: null, laps: [] };
let pace = "";
/// Age of the last thousand snapshots when they were drawn [ms], for measurements.
const ages = [];

/// Candidates are shown this long at most [ms], because the car drives on.
const OFFERED = 30e3;
let offered = { at: 0, searching: false };

const operator = $("operator");
operator.value = localStorage.getItem("operator") || "engineer";

async function act(car, action, expected = null) {
  cards.outcome(car, { done: null, text: "waiting for the car" });
  const result = await command(car, operator.value, action, expected);
  cards.outcome(car, result);
  return result;
}

/// A set is tried for this long before the car falls back [ms].
const TRIAL = 60e3;
/// Commands of this page that can be undone, the newest last.
const done = [];
const sets = async (car, name, revision, revert_after_ms) => {
  const before = snapshot?.cars.find((c) => c.car === car)?.set?.name;
  const result = await act(car, { params: { select: { name, revert_after_ms } } }, revision);
  if (result.done && before !== name) done.push({ car, what: `set ${name}`, undo: () => act(car, { params: "revert" }) });
  return result;
};
/// Goes back to the set before. To undo that puts the one in force again.
async function revert(car) {
  const before = snapshot?.cars.find((c) => c.car === car)?.set?.name;
  const result = await act(car, { params: "revert" });
  if (result.done && before) done.push({ car, what: `the way back to the set before (put ${before} in force again)`, undo: () => act(car, { params: { select: { name: before, revert_after_ms: null } } }) });
  return result;
}
const acts = {
  select,
  choose: (car, name, revision) => sets(car, name, revision, null),
  trial: (car, name, revision) => sets(car, name, revision, TRIAL),
  confirm: (car) => act(car, { params: "confirm" }),
  revert,
  record: (car, on) => act(car, { record: on ? "start" : "stop" }),
  dismiss: (car) => post("/dismiss", { car, operator: operator.value }),
  shadow: (car, name) => act(car, { params: { shadow: { name: name ?? null } } }),
  search,
  open: (car) => { select(car); large(true); },
  close: () => large(false),
};
const cards = new Cards($("cars"), acts);
const big = new Large($("large"), { ...acts, beside, cars: () => snapshot?.cars.map(({ car }) => car) ?? [] });
/// The car that is shown beside the large one.
let second = null;
const bigBeside = new Large($("large-2"), { ...acts, close: () => beside(null) });
function beside(car) {
  second = car;
  $("large-2").hidden = !car || $("large").hidden;
  if (car) $("large").dataset.half = "";
  else delete $("large").dataset.half;
}
const track = new Track($("map"), placed, picked);
const sound = new Sound($("sound"));
const log = new Log($("log"), $("alarm"), $("filter-car"), $("filter-severity"), sound, $("spoken"));
const link = connect(take, ({ up, silent_s: silent, rate }) => {
  const badge = $("link");
  badge.textContent = up ? (snapshot?.replay ? "replay" : "live") : `no news for ${lasting(silent)}: the pit wall does not answer`;
  badge.className = `badge ${up ? "up" : "down"}`;
  badge.title = up ? `${fixed(rate, 0)} snapshots a second` : badge.textContent;
  document.body.classList.toggle("cut", !up);
  const late = [...ages].sort((a, b) => a - b);
  pace = `${fixed(rate, 0)} snapshots /s; drawn after ${fixed(late[late.length >> 1], 0)} ms, p99 ${fixed(late[Math.floor(late.length * 0.99)], 0)} ms`;
  showWorst(up);
}, () => { if (!$("token").open) $("token").showModal(); });
$("token").addEventListener("close", () => {
  const value = $("token-value").value.trim();
  if (value) location.href = `/?token=${encodeURIComponent(value)}`;
});
link.operator(operator.value);
operator.addEventListener("change", () => {
  operator.value = operator.value.trim() || "engineer";
  localStorage.setItem("operator", operator.value);
  link.operator(operator.value);
});

/// Asks before something is changed. `answers` are [text, act]; the last button cancels.
function ask(text, ...answers) {
  const box = $("ask");
  $("ask-text").textContent = text;
  $("ask-answers").replaceChildren(...[...answers, ["cancel (Esc)", () => {}]].map(([label, act]) => {
    const button = element("button", "", label);
    button.addEventListener("click", () => { box.close(); act(); });
    return button;
  }));
  box.showModal();
  $("ask-answers").firstChild.focus();
}

/// The browser's title and icon show the worst state of all cars.
const WORST = ["LOST", "STALE", "BLIND", "UNKNOWN", "RELOCALIZING", "DEGRADED", "CONVERGING", "INIT", "LOCALIZED"];
let worstShown = "";
function showWorst(up) {
  const cars = snapshot?.cars ?? [];
  const worst = WORST.find((state) => cars.some((car) => car.state === state));
  const names = cars.filter((car) => car.state === worst).map((car) => car.car);
  const [shape, colour] = up ? STATES[worst] ?? ["", "none"] : ["✖", "none"];
  const text = !up ? "✖ no news · pit wall" : !worst ? "pit wall" : worst === "LOCALIZED" ? `${shape} ${cars.length} localized · pit wall` : `${shape} ${worst} ${names.slice(0, 2).join(", ")}${names.length > 2 ? " …" : ""} · pit wall`;
  if (text === worstShown) return;
  worstShown = text;
  document.title = text;
  const svg = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><circle cx="8" cy="8" r="7" fill="${palette()[colour]}" stroke="#888"/></svg>`;
  document.querySelector("link[rel=icon]").href = `data:image/svg+xml,${encodeURIComponent(svg)}`;
}

/// Undoes the last command that this page gave.
function undo() {
  const last = done.at(-1);
  if (!last) {
    $("hint").textContent = "no command of this page to undo";
    return;
  }
  ask(`Undo ${last.what} on ${last.car}?`, ["undo (Enter)", async () => {
    const result = await last.undo();
    if (result?.done) done.splice(done.indexOf(last), 1);
  }]);
}

function take(next) {
  snapshot = next;
  const first = next.epoch !== epoch || Boolean(next.hello);
  if (first) {
    epoch = next.epoch;
    log.restart();
    track.restart();
  }
  cards.keep(next.cars.map((car) => car.car));
  $("empty").hidden = next.cars.length > 0;
  if ((!selected || (first && !next.cars.some((car) => car.car === selected))) && next.cars.length) select(next.cars[0].car);
  cards.update(next.cars, selected, next.now / 1e9);
  if (next.hello) {
    cards.remember(next.hello.history);
    $("rerun").hidden = !next.hello.rerun;
    $("unprotected").hidden = !next.hello.warning;
    $("unprotected").textContent = next.hello.warning || "";
    if (next.hello.operator) {
      operator.value = next.hello.operator;
      operator.readOnly = true;
      operator.title = "the owner of your token";
    }
  }
  track.update(next, selected);
  log.add(next.log, next.acknowledged, first, next.hello?.open ?? []);
  if (next.recording) failed = false;
  else if (next.log.some((entry) => entry.kind === "recorder" && entry.severity === "critical")) failed = true;
  showRecording(next);
  showReplay(next.replay);
  showPeople(next.operators);
  const options = $("filter-car");
  if (options.length <= next.cars.length) {
    for (const { car } of next.cars) {
      if (![...options.options].some((option) => option.value === car)) options.append(new Option(car, car));
    }
  }
  const index = next.cars.findIndex((car) => car.car === selected);
  outdate(next.cars[index]);
  if (next.selected?.laps) laps = { car: next.selected.car, laps: next.selected.laps };
  if (!$("laps-panel").hidden) {
    showStandings($("standings"), next.cars, select);
    showLaps($("laps"), laps.laps, laps.car);
  }
  if (!$("numbers-panel").hidden) showNumbers($("numbers"), next.cars[index], pace);
  if (!$("large").hidden && index >= 0) big.update(next.cars[index], index, cards.history(selected), next.now / 1e9);
  showAnalysis(next);
  const other = next.cars.findIndex((car) => car.car === second);
  if (!$("large-2").hidden && other >= 0) bigBeside.update(next.cars[other], other, cards.history(second), next.now / 1e9);
  // After this frame is drawn.
  requestAnimationFrame(() => {
    link.drawn(next.number);
    ages.push(Date.now() - next.made / 1e6);
    if (ages.length > 1000) ages.shift();
  });
}

function select(car) {
  if (selected !== car) {
    offer([]);
    place(false);
  }
  selected = car;
  link.select(car);
}

function showPeople(names) {
  const others = names.length > 1 ? `${names.length} pages: ${[...new Set(names.filter(Boolean))].join(", ")}` : "";
  if ($("people").textContent !== others) $("people").textContent = others;
}

let saved = "";
let ending = false;
let failed = false;
function showRecording({ recording, disk_free: free, replay }) {
  const button = $("record");
  button.hidden = Boolean(replay);
  if (button.getAttribute("aria-pressed") !== String(Boolean(recording))) {
    press(button, Boolean(recording));
    button.textContent = recording ? "■ stop" : "● record";
  }
  const room = free === null ? "" : `${fixed(free / 1e9, 0)} GB free`;
  let text = saved || room;
  if (recording) {
    const missing = recording.missing + recording.overrun;
    const rate = recording.seconds > 5 ? recording.bytes / recording.seconds : 0;
    const left = free !== null && rate > 0 ? `, room for ${fixed(free / rate / 3600, 0)} h` : "";
    text = recording.error ?? `${lasting(recording.seconds)}, ${fixed(recording.bytes / 1e6, 1)} MB${left}, ${missing ? `${missing} MISSING` : "nothing missing"}`;
  }
  // The pit wall ends a recording that has failed, and logs it.
  document.body.classList.toggle("recording-failed", Boolean(recording?.error) || failed);
  if (failed && !recording) text = "RECORDING FAILED: start another one";
  if (ending) text = "ending: waiting for missing messages";
  if ($("recording").textContent !== text) $("recording").textContent = text;
  // In full, where the room does not suffice.
  const full = [text, recording?.file].filter(Boolean).join("\n");
  if ($("recording").title !== full) $("recording").title = full;
}

function record() {
  if (snapshot?.recording) ask("Stop the recording?", ["stop it (Enter)", () => setRecording(false)]);
  else setRecording(true);
}

async function setRecording(on) {
  $("record").disabled = true;
  ending = !on;
  const { ok, body } = await post("/record", { on, operator: operator.value });
  if (ok) failed = false;
  ending = false;
  $("record").disabled = false;
  if (!ok || on) {
    saved = ok ? "" : body;
    return;
  }
  const { messages, unanswered } = body.summary;
  const silent = unanswered.length ? `; no answer from ${unanswered.join(", ")}` : "";
  saved = `saved: ${messages} messages, ${body.missing ? `${body.missing} missing` : "nothing missing"}${silent}`;
}

let seeking = false;
function showReplay(replay) {
  $("replay").hidden = !replay;
  if (!replay) return;
  $("play").textContent = replay.playing ? "❚❚" : "▶";
  $("replay-time").textContent = `${lasting(replay.at_s)} of ${lasting(replay.duration_s)}`;
  $("replay-file").textContent = replay.file.split("/").at(-1);
  if (!seeking) $("seek").value = replay.duration_s ? 1000 * replay.at_s / replay.duration_s : 0;
  if (document.activeElement !== $("speed")) {
    const speeds = [...$("speed").options].map((option) => option.value);
    if (!speeds.includes(String(replay.speed))) $("speed").append(new Option(replay.speed));
    $("speed").value = String(replay.speed);
  }
  for (const id of ["place", "search", "mark", "sheet-button", "rates-button"]) $(id).disabled = true;
}
const setPlayback = (change) => snapshot?.replay && post("/replay", change);
const playPause = () => setPlayback({ playing: !snapshot.replay.playing });
const skip = (s) => setPlayback({ at: Math.max(0, (snapshot?.replay?.at_s ?? 0) + s) });
$("play").addEventListener("click", playPause);
$("seek").addEventListener("input", () => { seeking = true; });
$("seek").addEventListener("change", async () => {
  await setPlayback({ at: $("seek").value / 1000 * snapshot.replay.duration_s });
  seeking = false;
});
$("speed").addEventListener("change", () => setPlayback({ speed: Number($("speed").value) }));

function place(on) {
  track.placing = on && Boolean(selected);
  press($("place"), track.placing);
  $("map").classList.toggle("placing", track.placing);
  $("hint").textContent = track.placing ? `press at the position of ${selected}, drag towards its heading` : "";
}

async function placed(x, y, heading) {
  place(false);
  const car = selected;
  const before = snapshot?.cars.find((c) => c.car === car)?.pose;
  const result = await act(car, { pose: { x, y, heading } });
  if (!result.done) return;
  cards.outcome(car, { done: true, text: `pose set to ${fixed(x, 2)}, ${fixed(y, 2)} m, ${fixed(heading * 180 / Math.PI, 0)}°${before ? `: ${fixed(Math.hypot(x - before.x_m, y - before.y_m), 2)} m from the estimate before` : ""}` });
  if (before) rememberPose(car, before);
}

/// A pose can be given back only while the car stands where it stood.
function rememberPose(car, { x_m: x, y_m: y, heading_rad: heading }) {
  done.push({
    car, what: `the pose (back to ${fixed(x, 2)}, ${fixed(y, 2)} m)`,
    undo: async () => {
      const speed = snapshot?.cars.find((c) => c.car === car)?.pose?.speed_mps ?? 0;
      if (speed < 0.3) return act(car, { pose: { x, y, heading } });
      cards.outcome(car, { done: false, text: "the car drives: its pose before is old. Search the map instead (g)" });
      return null;
    },
  });
}

/// Shows the candidates on the track and as buttons. Scores only compare candidates with each other.
function offer(candidates) {
  track.candidates = candidates;
  offered = { at: performance.now(), searching: false };
  $("candidates").hidden = candidates.length < 2;
  const best = Math.max(...candidates.map(({ score }) => score));
  $("candidates").replaceChildren(...candidates.map(({ number, score }) => {
    const button = element("button", "", score === best ? `${number}: best` : `${number}: ${fixed(score / best * 100, 0)} %`);
    button.title = `use candidate ${number}${score === best ? "" : ", with its score relative to the best"}`;
    button.addEventListener("click", () => picked(number));
    return button;
  }));
  $("hint").textContent = candidates.length > 1 ? `${selected} has ${candidates.length} candidates and uses the first: pick another here or on the track` : "";
}

/// Removes the candidates when the car is localized, or when they are old.
function outdate(car) {
  if (!track.candidates.length || !car) return;
  if (car.state !== "LOCALIZED") offered.searching = true;
  const age = performance.now() - offered.at;
  if (age > OFFERED || (offered.searching && car.state === "LOCALIZED")) offer([]);
}

async function search(car = selected) {
  if (!car) return;
  select(car);
  const before = snapshot?.cars.find((c) => c.car === car)?.pose;
  const result = await act(car, { relocalize: "search" });
  const candidates = result.verdict?.answer?.outcome?.done?.reply?.candidates ?? [];
  if (result.done && before) rememberPose(car, before);
  if (result.done) {
    const best = candidates.reduce((a, c) => (a && a.score >= c.score ? a : c), null);
    const found = best ? `${candidates.length} ${candidates.length === 1 ? "place fits" : "places fit"}: number ${best.number} at ${fixed(best.pose.x, 1)}, ${fixed(best.pose.y, 1)} m fits best` : "the search has begun; no place fits yet";
    cards.outcome(car, { done: true, text: found });
  }
  if (selected === car) offer(candidates);
}

async function picked(candidate) {
  offer([]);
  const car = selected;
  const before = snapshot?.cars.find((c) => c.car === car)?.pose;
  const result = await act(car, { relocalize: { pick: { candidate } } });
  if (result.done && before) rememberPose(car, before);
}

/// The telemetry rates of the selected car: what it sends of each kind every second.
const RATES = ["pose", "cloud", "scan", "health"];
let ratesBefore = null;
async function rates() {
  if (!selected || snapshot?.replay) return;
  const car = selected;
  const result = await act(car, { rates: "get" });
  const now = result.verdict?.answer?.outcome?.done?.reply?.rates;
  if (!now) return;
  ratesBefore = { car, rates: now };
  for (const kind of RATES) $(`rate-${kind}`).value = String(now[kind]);
  $("rate-recorded").checked = now.recorded;
  $("rates-title").textContent = `Telemetry rates of ${car}`;
  $("rates").returnValue = "";
  $("rates").showModal();
}
$("rates").addEventListener("close", async () => {
  if ($("rates").returnValue !== "ok" || !ratesBefore) return;
  const { car, rates: before } = ratesBefore;
  const wanted = { recorded: $("rate-recorded").checked };
  for (const kind of RATES) wanted[kind] = Number($(`rate-${kind}`).value);
  const result = await act(car, { rates: { set: wanted } });
  if (result.done) done.push({ car, what: "the telemetry rates", undo: () => act(car, { rates: { set: before } }) });
});

function follow(on = !track.follow) {
  track.follow = on;
  press($("follow"), on);
}

function paint() {
  const [name, legend] = track.paintNext();
  $("paint").textContent = `paint: ${name}`;
  press($("paint"), name !== "off");
  $("legend-paint").hidden = name === "off";
  const colours = palette();
  $("legend-paint").replaceChildren(element("span", "", name), ...legend.map(([colour, text]) => {
    const item = element("span");
    const swatch = element("i", colour);
    swatch.style.background = colours[colour];
    item.append(swatch, text);
    return item;
  }));
}

function large(on = $("large").hidden) {
  $("large").hidden = !on || !selected;
  beside(on ? second : null);
  if (!on) $("map").focus();
  else $("large").scrollIntoView({ block: "nearest" });
}

function shadow() {
  const car = snapshot?.cars.find(({ car }) => car === selected);
  if (car) acts.shadow(selected, car.shadow ? null : otherSet(car));
}

function mark() {
  if (!selected || snapshot?.replay) return;
  $("marker-text").value = "";
  $("marker").returnValue = "";
  $("marker").showModal();
}
$("marker").addEventListener("close", () => {
  const text = $("marker-text").value.trim();
  const range = $("marker-range").value;
  const lap = snapshot?.cars.find(({ car }) => car === selected)?.last_lap_s;
  const for_s = range === "lap" ? lap ?? null : range ? Number(range) : null;
  if ($("marker").returnValue === "ok" && text) post("/mark", { car: selected, operator: operator.value, text, for_s });
});

/// The run sheet of the selected car.
const SHEET = ["heat", "tyre", "battery", "notes"];
function sheet() {
  if (!selected || snapshot?.replay) return;
  const known = Object.fromEntries((snapshot?.cars.find(({ car }) => car === selected)?.run_sheet ?? "").split("; ").map((part) => part.split(": ")));
  for (const field of SHEET) $(`sheet-${field}`).value = known[field] ?? "";
  $("sheet-title").textContent = `Run sheet of ${selected}`;
  $("sheet").returnValue = "";
  $("sheet").showModal();
}
$("sheet").addEventListener("close", () => {
  const parts = SHEET.map((field) => [field, $(`sheet-${field}`).value.trim().replaceAll("; ", ", ")]).filter(([, value]) => value);
  if ($("sheet").returnValue === "ok" && parts.length) {
    post("/mark", { car: selected, operator: operator.value, text: parts.map(([field, value]) => `${field}: ${value}`).join("; "), run_sheet: true });
  }
});

/// Shows the Rerun viewer instead of the track, or removes it with all its resources.
async function rerun() {
  const viewer = $("viewer");
  const on = viewer.hidden;
  if (on) {
    const { ok, body } = await post("/rerun", {});
    if (!ok) {
      $("hint").textContent = body || "this program was built without Rerun";
      return;
    }
    viewer.src = body.url;
  } else {
    viewer.src = "about:blank";
  }
  viewer.hidden = !on;
  document.querySelector("main").classList.toggle("deep", on);
  press($("rerun"), on);
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "light" : "dark";
  localStorage.setItem("theme", name);
}
const prefersLight = matchMedia("(prefers-color-scheme: light)").matches;
theme(localStorage.getItem("theme") || (prefersLight ? "light" : "dark"));
const otherTheme = () => theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");

/// Laps over the track: made when it is shown first, updated when laps have ended.
let analysis = null;
let analysed = null;
async function showAnalysis(next) {
  if ($("analysis-panel").hidden || !next) return;
  const key = `${next.epoch}:${next.analysed}`;
  if (key === analysed) return;
  analysed = key;
  analysis ??= new Analysis($("analysis-panel"), { load: loadLap, keep: keepSectors, extra: [otherSession()] });
  const response = await fetch("/analysis").catch(() => null);
  if (response?.ok) analysis.update(await response.json());
  else analysed = null;
}
async function loadLap(id) {
  const response = await fetch(`/analysis/lap?id=${encodeURIComponent(id)}`).catch(() => null);
  return response?.ok ? response.json() : null;
}
async function keepSectors(track, borders) {
  const { ok, body } = await post("/sectors", { track, borders });
  analysed = null;
  return ok ? null : body;
}
/// A list of recordings whose laps can be laid over these.
function otherSession() {
  const list = element("select");
  list.setAttribute("aria-label", "Laps of another recording");
  const fill = async () => {
    const files = await fetch("/analysis/files").then((r) => r.json()).catch(() => []);
    list.replaceChildren(new Option("+ other recording", ""), ...files.map((file) => new Option(file)));
  };
  list.append(new Option("+ other recording", ""));
  list.addEventListener("pointerdown", () => list.options.length < 2 && fill());
  list.addEventListener("focus", () => list.options.length < 2 && fill());
  list.addEventListener("change", async () => {
    if (!list.value) return;
    list.disabled = true;
    const { ok, body } = await post("/analysis/load", { file: list.value });
    list.disabled = false;
    list.value = "";
    if (!ok) analysis.say(body);
    analysed = null;
  });
  return list;
}

const TABS = ["log", "laps", "numbers", "analysis"];
const tab = (shown) => {
  for (const other of TABS) {
    $(`tab-${other}`).setAttribute("aria-selected", String(other === shown));
    $(`tab-${other}`).tabIndex = other === shown ? 0 : -1;
    $(`${other}-panel`).hidden = other !== shown;
  }
  // The plots need the room of the track.
  document.querySelector("main").classList.toggle("analysing", shown === "analysis");
  if (shown === "analysis") showAnalysis(snapshot);
};
for (const name of TABS) $(`tab-${name}`).addEventListener("click", () => tab(name));
document.querySelector("[role=tablist]").addEventListener("keydown", (event) => {
  const at = TABS.findIndex((name) => event.target.id === `tab-${name}`);
  const next = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: TABS.length - 1 }[event.key];
  if (at < 0 || next === undefined) return;
  const name = TABS[(next + TABS.length) % TABS.length];
  tab(name);
  $(`tab-${name}`).focus();
  event.preventDefault();
  event.stopPropagation();
});
for (const name of TABS.slice(1)) $(`tab-${name}`).tabIndex = -1;
for (const [word, [shape, , meaning]] of Object.entries(STATES)) $("legend").append(element("li", "", `${shape} ${word}: ${meaning}`));

/// The engineer's alarm limits on the track of the selected car.
async function editLimits() {
  if (!selected) return;
  const response = await fetch(`/limits/${selected}`).catch(() => null);
  if (!response?.ok) return;
  const { limits, channels } = await response.json();
  $("limits-fault").textContent = limits ? "" : `${selected} has no track with a raceline`;
  $("limits-table").replaceChildren(...channels.filter((c) => c.worse !== "neither").map((c) => {
    const row = element("tr");
    const input = element("input");
    input.type = "number";
    input.step = "any";
    input.name = c.name;
    input.dataset.factor = c.factor;
    input.id = `limit-${c.name}`;
    const limit = limits?.[c.name];
    input.value = limit === undefined ? "" : Number((limit * c.factor).toPrecision(6));
    const label = element("label", "", `${c.label} ${{ low: "below", high: "above", far: "beyond ±" }[c.worse]}`);
    label.htmlFor = input.id;
    const [name, value] = [element("td"), element("td")];
    name.append(label);
    value.append(input, ` ${c.unit}`);
    row.append(name, value);
    return row;
  }));
  $("limits").returnValue = "";
  $("limits").showModal();
}
$("limits").addEventListener("close", async () => {
  if ($("limits").returnValue !== "ok") return;
  const limits = {};
  for (const input of $("limits-table").querySelectorAll("input")) {
    if (input.value !== "") limits[input.name] = Number(input.value) / Number(input.dataset.factor);
  }
  const { ok, body } = await post("/limits", { car: selected, limits, operator: operator.value });
  if (!ok) $("hint").textContent = body;
});

const acknowledge = () => post("/acknowledge", { operator: operator.value });
const fit = () => { follow(false); track.fit(); };
const help = () => $("help").showModal();
const sessions = new SessionDialog($("sessions"), { words: $("sessions-words"), table: $("sessions-table"), said: $("sessions-said") });
const showSessions = () => sessions.open();
const CLICKS = {
  record, theme: otherTheme, "help-button": help, "sessions-button": showSessions, fit, follow: () => follow(), paint, place: () => place(!track.placing), search: () => search(),
  mark, rerun, acknowledge, alarm: acknowledge, "limits-button": editLimits, "rates-button": rates, "sheet-button": sheet, sound: () => sound.toggle(),
};
for (const [id, action] of Object.entries(CLICKS)) $(id).addEventListener("click", action);

const step = (by) => {
  const index = snapshot?.cars.findIndex(({ car }) => car === selected) ?? -1;
  const car = snapshot?.cars[Math.min(Math.max(index + by, 0), snapshot.cars.length - 1)];
  if (!car) return;
  select(car.car);
  document.querySelector(`.card[data-car="${car.car}"]`)?.scrollIntoView({ block: "nearest" });
};
const askForSet = (name) => {
  const car = snapshot?.cars.find((c) => c.car === selected);
  if (!car?.set || car.set.name === name) return;
  ask(`Put set ${name} in force on ${selected}? ${car.set.name} is in force.`,
    [`put ${name} in force (Enter)`, () => acts.choose(selected, name, car.set.revision)],
    ["try it for 60 s, then fall back", () => acts.trial(selected, name, car.set.revision)]);
};
const KEYS = {
  r: record, t: otherTheme, "?": help, b: showSessions, y: rates, 0: fit, f: () => follow(), m: mark, w: sheet, z: undo,
  g: () => selected && ask(`Search the whole map for ${selected}? It gives up its pose meanwhile.`, ["search (Enter)", () => search()]),
  x: () => selected && ask(`Go back to the set before on ${selected}?`, ["go back (Enter)", () => acts.revert(selected)]), p: paint, s: shadow, o: () => large(),
  v: () => $("rerun").hidden || rerun(), n: () => sound.toggle(), i: () => place(!track.placing), a: acknowledge,
  e: () => tab("log"), l: () => tab("laps"), u: () => tab("numbers"), d: () => tab("analysis"),
  "+": () => track.zoom(1.3), "=": () => track.zoom(1.3), "-": () => track.zoom(1 / 1.3),
  c: () => selected && act(selected, { params: "confirm" }),
  H: () => askForSet("hq"), L: () => askForSet("lq"),
  ArrowDown: () => step(1), ArrowUp: () => step(-1),
  ",": () => skip(-5), ".": () => skip(5),
  Escape: () => { place(false); offer([]); large(false); },
};
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input, select") || document.querySelector("dialog[open]")) return;
  const number = Number(event.key);
  if (number >= 1 && number <= 9) {
    const car = snapshot?.cars[number - 1];
    if (car) select(car.car);
    return;
  }
  // A focused button takes the space bar for itself.
  const action = event.key === " " ? !event.target.matches("button") && snapshot?.replay && playPause : KEYS[event.key];
  if (action) {
    event.preventDefault();
    action();
  }
});

// The page's state, for measurements and tests.
window.pitwall = { ages, toCanvas: (x, y) => track.toCanvas(x, y), get selected() { return selected; }, get analysis() { return analysis; }, get snapshot() { return snapshot; } };
