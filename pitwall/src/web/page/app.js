// Puts the page together: snapshots to views, buttons and keys to commands.

import { command, connect, post } from "/link.js";
import { Cards, STATES, fixed } from "/cards.js";
import { Track } from "/track.js";
import { Log, showLaps, showNumbers } from "/lists.js";

const $ = (id) => document.getElementById(id);
let snapshot = null;
let selected = null;
let first = true;

const operator = $("operator");
operator.value = localStorage.getItem("operator") || "engineer";
operator.addEventListener("change", () => {
  operator.value = operator.value.trim() || "engineer";
  localStorage.setItem("operator", operator.value);
});

async function act(car, action, expected = null) {
  cards.outcome(car, { done: null, text: "asking the car" });
  const result = await command(car, operator.value, action, expected);
  cards.outcome(car, result);
  return result;
}

const cards = new Cards($("cars"), act, select);
const track = new Track($("map"), placed, picked);
const log = new Log($("log"), $("alarm"), $("filter-car"), $("filter-severity"));
const link = connect(take, (up) => {
  const badge = $("link");
  badge.textContent = up ? "live" : "the pit wall's program does not answer";
  badge.className = `badge ${up ? "up" : "down"}`;
  document.body.classList.toggle("cut", !up);
  if (!up) { first = true; log.restart(); }
});

function take(next) {
  snapshot = next;
  $("empty").hidden = next.cars.length > 0;
  if (!selected && next.cars.length) select(next.cars[0].car);
  cards.update(next.cars, selected);
  track.update(next, selected);
  log.add(next.log, first);
  first = false;
  showRecording(next.recording);
  const options = $("filter-car");
  for (const { car } of next.cars) {
    if (![...options.options].some((option) => option.value === car)) options.append(new Option(car, car));
  }
  if (!$("laps-panel").hidden && next.selected) showLaps($("laps"), next.selected.laps, next.selected.car);
  if (!$("numbers-panel").hidden) showNumbers($("numbers"), next.cars.find((car) => car.car === selected));
}

function select(car) {
  if (selected !== car) {
    track.candidates = [];
    place(false);
  }
  selected = car;
  link.select(car);
}

function showRecording(recording) {
  const button = $("record");
  button.setAttribute("aria-pressed", String(Boolean(recording)));
  button.textContent = recording ? "■ stop" : "● record";
  if (recording) {
    const missing = recording.missing + recording.overrun;
    $("recording").textContent = recording.error ??
      `${recording.file}  ${fixed(recording.seconds, 0)} s, ${fixed(recording.bytes / 1e6, 1)} MB, ${missing ? `${missing} missing` : "nothing missing"}`;
  }
}

async function record() {
  const on = !snapshot?.recording;
  $("record").disabled = true;
  const { ok, body } = await post("/record", { on });
  $("record").disabled = false;
  $("recording").textContent = !ok ? body : on ? body.recording
    : `saved: ${body.summary.messages} messages, ${body.missing ? `${body.missing} missing` : "nothing missing"}`;
}

function place(on) {
  track.placing = on && Boolean(selected);
  $("place").setAttribute("aria-pressed", String(track.placing));
  $("hint").textContent = track.placing ? `press where ${selected} stands, drag towards its heading` : "";
}

async function placed(x, y, heading) {
  place(false);
  await act(selected, { pose: { x, y, heading } });
}

async function search() {
  if (!selected) return;
  const result = await act(selected, { relocalize: "search" });
  const reply = result.verdict?.answer?.outcome?.done?.reply;
  track.candidates = reply?.candidates ?? [];
  $("hint").textContent = track.candidates.length > 1 ? "click a candidate to take it" : "";
}

async function picked(candidate) {
  $("hint").textContent = "";
  const result = await act(selected, { relocalize: { pick: { candidate } } });
  if (result.done) track.candidates = [];
}

function follow() {
  track.follow = !track.follow;
  $("follow").setAttribute("aria-pressed", String(track.follow));
}

function mark() {
  if (!selected) return;
  $("marker-text").value = "";
  $("marker").returnValue = "";
  $("marker").showModal();
}
$("marker").addEventListener("close", () => {
  const text = $("marker-text").value.trim();
  if ($("marker").returnValue === "ok" && text) post("/mark", { car: selected, operator: operator.value, text });
});

/// Shows the Rerun viewer in place of the track, or takes it away again with all that it uses.
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
  $("rerun").setAttribute("aria-pressed", String(on));
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "light" : "dark";
  localStorage.setItem("theme", name);
}
const prefersLight = matchMedia("(prefers-color-scheme: light)").matches;
theme(localStorage.getItem("theme") || (prefersLight ? "light" : "dark"));
const otherTheme = () => theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");

const TABS = ["log", "laps", "numbers"];
for (const tab of TABS) {
  $(`tab-${tab}`).addEventListener("click", () => {
    for (const other of TABS) {
      $(`tab-${other}`).setAttribute("aria-selected", String(other === tab));
      $(`${other}-panel`).hidden = other !== tab;
    }
  });
}
for (const [word, [shape, , meaning]] of Object.entries(STATES)) {
  const item = document.createElement("li");
  item.textContent = `${shape} ${word}: ${meaning}`;
  $("legend").append(item);
}
const fit = () => { track.follow = false; $("follow").setAttribute("aria-pressed", "false"); track.fit(); };
$("record").addEventListener("click", record);
$("theme").addEventListener("click", otherTheme);
$("help-button").addEventListener("click", () => $("help").showModal());
$("fit").addEventListener("click", fit);
$("follow").addEventListener("click", follow);
$("place").addEventListener("click", () => place(!track.placing));
$("search").addEventListener("click", search);
$("mark").addEventListener("click", mark);
$("rerun").addEventListener("click", rerun);
$("acknowledge").addEventListener("click", () => log.acknowledge());

const KEYS = {
  r: record, t: otherTheme, "?": () => $("help").showModal(), 0: fit, f: follow, g: search, m: mark, v: rerun,
  i: () => place(!track.placing), a: () => log.acknowledge(),
  "+": () => track.zoom(1.3), "=": () => track.zoom(1.3), "-": () => track.zoom(1 / 1.3),
  c: () => selected && act(selected, { params: "confirm" }),
  H: () => cards.cards.get(selected)?.choose("hq"), L: () => cards.cards.get(selected)?.choose("lq"),
  Escape: () => { place(false); track.candidates = []; $("hint").textContent = ""; },
};
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input, select") || document.querySelector("dialog[open]")) return;
  const number = Number(event.key);
  if (number >= 1 && number <= 9) {
    const car = snapshot?.cars[number - 1];
    if (car) select(car.car);
    return;
  }
  const action = KEYS[event.key];
  if (action) {
    event.preventDefault();
    action();
  }
});
