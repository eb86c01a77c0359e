// The cars' cards. Elements are made once and then only their text changes.

import { SPAN_S, plot } from "/chart.js";

/// Shape, colour class and meaning of each state. Shape and word have the same meaning as the colour.
export const STATES = {
  INIT: ["○", "none", "no pose yet"],
  CONVERGING: ["◐", "busy", "the pose is not confirmed yet"],
  LOCALIZED: ["●", "good", "the pose is good enough for racing"],
  DEGRADED: ["▲", "warn", "the pose is probably right; something is wrong"],
  LOST: ["✖", "bad", "the pose is wrong"],
  RELOCALIZING: ["↻", "busy", "searching the whole map"],
  STALE: ["■", "bad", "no sensor data on the car"],
  UNKNOWN: ["?", "none", "the health messages cannot be decoded"],
  BLIND: ["□", "none", "nothing arrives from the car"],
};

const COLOURS = ["#5aa9ff", "#ff9d5c", "#b98cff", "#2fd0c8", "#ff6fae", "#c9c93a", "#7fd46b", "#e07a5f", "#9fb4ff", "#c0a080"];

/// A car's own colour, by its place in the list.
export const colourOf = (index) => COLOURS[index % COLOURS.length];

export const fixed = (value, digits, unit = "") =>
  value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1") + unit;

/// Formats a duration: 7 s, 3:05, 1:02:30.
export const lasting = (s) => {
  if (s === null || s === undefined) return "–";
  if (s < 60) return `${s < 10 ? s.toFixed(1) : Math.floor(s)} s`;
  const two = (n) => String(Math.floor(n)).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)}` : `${Math.floor(s / 3600)}:${two(s / 60 % 60)}:${two(s % 60)}`;
};

export const element = (tag, className, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
};

export const setText = (node, text) => { if (node.textContent !== text) node.textContent = text; };

/// Milliseconds, with a digit behind the point where there is room, and seconds where they are many.
const ms = (value) => (value >= 1000 ? lasting(value / 1e3) : fixed(value, value < 10 ? 1 : 0, " ms"));

/// How old the pose is.
const age = ({ pose }) => (pose && pose.age_s >= 1 ? lasting(pose.age_s) : fixed(pose && pose.age_s * 1e3, 0, " ms"));

export const missing = (car) => car.missing;

/// Never rounded up to all.
const share = (value) => (value === null || value === undefined ? "–" : value === 1 ? "100 %" : fixed(Math.min(value * 100, 99.99), 2, " %"));

/// Label, text, warning condition, and tooltip.
export const FACTS = [
  ["speed", (c) => fixed(c.pose?.speed_mps, 1, " m/s"), null, "over ground"],
  ["age", (c) => age(c), (c) => c.pose?.age_s > 0.15, "age of the pose shown"],
  ["alignment", (c) => fixed(c.health?.metrics && c.health.metrics.alignment * 100, 0, " %"), (c) => c.health?.metrics?.alignment < 0.7, "share of the beams that end at a wall of the map"],
  ["slip", (c) => fixed(c.health?.metrics && c.health.metrics.slip * 100, 0, " %"), (c) => Math.abs(c.health?.metrics?.slip) > 0.08, "share of odometry's distance that was not driven"],
  ["last lap", (c) => fixed(c.last_lap_s, 2, " s"), null, "the last lap"],
  ["best lap", (c) => fixed(c.best_lap_s, 2, " s"), null, "the best lap"],
  ["poses", (c) => fixed(c.streams.pose?.rate_hz, 0, " /s"), null, "poses that arrive"],
  ["round trip", (c) => ms(c.round_trip_s && c.round_trip_s * 1e3), (c) => c.round_trip_s > 0.1, "to the car and back"],
  ["update p99", (c) => ms(c.load && c.load.update_us.p99 / 1e3), (c) => c.load?.update_us.p99 > 20e3, "time of a filter update"],
  ["CPU", (c) => fixed(c.load && c.load.cpu_process * 100, 0, " %"), null, "of one core, by the car's node"],
  ["temp.", (c) => fixed(c.load?.temperature, 0, " °C"), (c) => c.load?.temperature > 80 || c.load?.throttled, "the hottest sensor; – if the machine does not report it"],
  ["coverage", (c) => share(c.coverage), (c) => c.coverage < 0.999, "share of what the car sent that is here, of the streams that must be complete"],
];

/// The state of the recording on a car's own disk.
export const recorderText = (state) => {
  const gigabytes = (bytes) => fixed(bytes / 1e9, 2);
  const what = !state.recording ? "not recording" : state.error ? `recording FAILS: ${state.error}` : `recording, file ${state.file}`;
  const dropped = state.dropped ? `; ${state.dropped} messages not recorded` : "";
  return `${what}; ${gigabytes(state.bytes)} of ${gigabytes(state.limit)} GB used, ${gigabytes(state.free)} GB free${dropped}`;
};

/// The set to compare with the one in force.
export const otherSet = (car) => {
  const names = car.set?.available ?? [];
  const proposed = car.health?.proposal?.set ?? (car.set?.name === "hq" ? "lq" : "hq");
  return names.includes(proposed) ? proposed : names.find((name) => name !== car.set?.name);
};

/// The comparison in one sentence.
export const verdict = (shadow) => {
  const c = shadow.comparison;
  if (!c) return `${shadow.set} runs in the shadow; there is no comparison yet`;
  const [force, other] = [c.in_force.name, shadow.set];
  const lead = c.shadow_better - c.force_better;
  const better = Math.abs(lead) < 0.1 ? `${force} and ${other} fit alike` : lead > 0 ? `${other} fits better than ${force}` : `${force} fits better than ${other}`;
  return `${better}: ${fixed(c.shadow_better * 100, 0)} % of scans for ${other}, ${fixed(c.force_better * 100, 0)} % for ${force}; ` +
    `alignment ${fixed(c.shadow.alignment * 100, 0)} / ${fixed(c.force.alignment * 100, 0)} %, poses ${fixed(c.distance * 100, 1)} cm apart`;
};

/// Period at which numbers are updated [ms]. Nobody reads faster, and it saves time with twenty cars.
/// States and causes change at once.
const READABLE = 190;

/// Heights of a card [px]: whole, and with less on it.
const WHOLE = 274, TIGHT = 208;

/// All cards. `acts` gives commands: choose(car, set), trial(car, set), revert(car), confirm(car), dismiss(car), shadow(car, set or null), search(car), open(car), select(car).
export class Cards {
  constructor(root, acts) {
    this.root = root;
    this.acts = acts;
    this.cards = new Map();
  }

  update(cars, selected, now) {
    const [count, room] = [cars.length, this.root.clientHeight];
    const whole = count * WHOLE <= room, tight = WHOLE + (count - 1) * TIGHT <= room || count <= 3;
    this.root.classList.toggle("tight", !whole && tight);
    this.root.classList.toggle("many", !whole && !tight);
    const read = performance.now() - (this.read ?? 0) >= READABLE;
    if (read) this.read = performance.now();
    cars.forEach((car, index) => {
      let card = this.cards.get(car.car);
      if (!card) {
        card = new Card(car.car, index, this.acts);
        this.cards.set(car.car, card);
        const next = cars.slice(index + 1).map((c) => this.cards.get(c.car)?.root).find(Boolean);
        this.root.insertBefore(card.root, next ?? null);
      }
      card.now = now;
      card.update(car, index, car.car === selected, read);
    });
  }

  /// Sets the history of each car.
  remember(history) {
    for (const card of this.cards.values()) card.history = [];
    for (const [name, moments] of Object.entries(history)) {
      const card = this.cards.get(name);
      if (card) card.history = moments.map((m) => ({ ...m, at: m.at / 1e9, state: m.state.toUpperCase() }));
    }
  }

  history(car) { return this.cards.get(car)?.history ?? []; }
  outcome(car, result) { this.cards.get(car)?.outcome(result); }

  /// Removes a car that is gone, as after a jump of a replay.
  keep(names) {
    for (const [name, card] of this.cards) {
      if (!names.includes(name)) {
        card.root.remove();
        this.cards.delete(name);
      }
    }
  }
}

class Card {
  constructor(name, index, acts) {
    this.name = name;
    this.acts = acts;
    this.history = [];
    this.outcomeShown = null;
    this.root = element("article", "card");
    this.root.tabIndex = 0;
    this.root.dataset.car = name;
    this.root.addEventListener("click", () => acts.select(name));
    this.root.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target === this.root) acts.select(name);
    });
    const head = element("header");
    this.chip = element("span", "chip");
    this.since = element("span", "for");
    this.state = element("span", "state");
    const open = this.button("⤢", "open this car large (o)", () => acts.open(name));
    open.className = "open";
    this.dismiss = this.button("✕", "hide this car, which is gone, until it is back", () => acts.dismiss(name));
    this.dismiss.className = "open";
    this.dismiss.hidden = true;
    head.append(this.chip, element("span", "name", name), this.state, this.since, this.dismiss, open);
    this.causes = element("div", "causes");
    this.brief = element("div", "brief");
    const detail = element("div", "detail");
    const facts = element("div", "facts");
    this.facts = FACTS.map(([label, , , meaning]) => {
      const cell = element("div");
      cell.title = meaning;
      const value = element("b");
      cell.append(element("span", "", label), value);
      facts.append(cell);
      return value;
    });
    this.spark = element("canvas", "spark");
    this.spark.title = "alignment over the last two minutes; the colour is the state";
    this.sets = element("div", "sets");
    this.setButtons = new Map();
    const note = element("div", "note");
    this.note = element("p");
    this.note.setAttribute("role", "status");
    this.shadow = this.button("shadow", "run another set beside this one, and compare (s)", () => {
      if (this.car) acts.shadow(name, this.car.shadow ? null : otherSet(this.car));
    });
    this.find = this.button("find", "start a global search (g)", () => acts.search(name));
    this.trial = this.button("try", "try the other set for 60 s; the car falls back unless it is confirmed", () => acts.trial(name, otherSet(this.car), this.revision));
    this.confirm = this.button("confirm", "keep the set in force (c)", () => acts.confirm(name));
    this.revert = this.button("back", "go back to the set before (x)", () => acts.revert(name));
    note.append(this.note, this.trial, this.confirm, this.revert, this.shadow, this.find);
    detail.append(facts, this.spark, this.sets, note);
    this.root.append(head, this.causes, this.brief, detail);
  }

  button(text, title, act) {
    const button = element("button", "", text);
    button.title = title;
    button.addEventListener("click", (event) => {
      event.stopPropagation();
      act();
    });
    return button;
  }

  update(car, index, selected, read) {
    this.car = car;
    const [shape, colour] = STATES[car.state] ?? ["?", "none"];
    if (this.dismiss.hidden !== car.alive) this.dismiss.hidden = car.alive;
    const className = `card ${colour}${car.blind ? " blind" : ""}${selected ? " selected" : ""}`;
    const changed = this.root.className !== className;
    if (changed) this.root.className = className;
    if (this.index !== index) { this.index = index; this.chip.style.background = colourOf(index); }
    setText(this.state, `${shape} ${car.state}`);
    if (read || changed) setText(this.since, car.blind ? `${lasting(car.quiet_s)} silent` : lasting(car.state_for_s));
    const causes = car.causes.length > 1 ? `${car.causes[0]}; +${car.causes.length - 1}` : car.causes[0] ?? "";
    if (read || changed) setText(this.causes, causes);
    if ((read || changed) && this.causes.title !== car.causes.join("\n")) this.causes.title = car.causes.join("\n");
    if (!read && !changed) return;
    const hidden = this.root.parentElement?.classList.contains("many") && !selected;
    if (hidden) {
      setText(this.brief, [lasting(car.state_for_s), car.set?.name ?? "–", fixed(car.health?.metrics && car.health.metrics.alignment * 100, 0, " %"),
        age(car)].join(" · "));
    } else {
      FACTS.forEach(([, text, off], i) => {
        setText(this.facts[i], text(car));
        this.facts[i].classList.toggle("off", Boolean(off?.(car)));
      });
      this.updateSets(car);
      this.updateNote(car);
    }
    this.updateSpark(car, !hidden);
  }

  updateSets(car) {
    const set = car.set;
    const names = [...(set?.available ?? [])];
    if (set && !names.includes(set.name)) names.unshift(set.name);
    const key = names.join();
    if (this.sets.dataset.names !== key) {
      this.sets.dataset.names = key;
      this.setButtons.clear();
      this.sets.replaceChildren(...names.map((name) => {
        const button = this.button(name, `put set ${name} in force`, () => this.choose(name));
        button.dataset.set = name;
        this.setButtons.set(name, button);
        return button;
      }));
    }
    const title = set ? `revision ${set.revision}, put in force by ${set.who}` : "";
    for (const [name, button] of this.setButtons) {
      const pressed = String(name === set?.name);
      if (button.getAttribute("aria-pressed") !== pressed) button.setAttribute("aria-pressed", pressed);
      const proposed = car.health?.proposal?.set === name;
      button.classList.toggle("proposed", proposed);
      setText(button, proposed ? `▸ ${name}` : name);
    }
    if (this.sets.title !== title) this.sets.title = title;
    this.revision = set?.revision ?? null;
  }

  /// The note about the sets: for a while the outcome of the last command, then the car's own state.
  updateNote(car) {
    setText(this.shadow, car.shadow ? "■ shadow" : "shadow");
    const set = car.set;
    const other = otherSet(car);
    this.trial.hidden = !other || Boolean(set?.reverts_to);
    if (other) setText(this.trial, `try ${other} 60 s`);
    this.confirm.hidden = !set?.reverts_to;
    const answer = this.outcomeShown && (this.outcomeShown.done !== true || performance.now() - this.outcomeShown.at < 8000) ? this.outcomeShown : null;
    let [kind, text] = ["", set ? `${set.name} revision ${set.revision} by ${set.who}` : ""];
    if (car.health?.auto) text += "; switches by itself";
    if (car.health?.proposal) [kind, text] = ["warn", `proposes ${car.health.proposal.set}: ${car.health.proposal.evidence}`];
    if (car.shadow) [kind, text] = ["", verdict(car.shadow)];
    if (set?.reverts_to) [kind, text] = ["warn", `falls back to ${set.reverts_to} in ${fixed(set.reverts_in_s, 0)} s unless confirmed (c)`];
    if (answer) [kind, text] = [answer.done === null ? "" : answer.done ? "done" : "failed", (answer.done === null ? "… " : answer.done ? "✓ " : "✗ ") + answer.text];
    if (this.note.className !== kind) this.note.className = kind;
    setText(this.note, text);
    if (this.note.title !== text) this.note.title = text;
  }

  /// Puts a set in force, if the revision shown is still in force.
  async choose(name) {
    const button = this.setButtons.get(name);
    if (!button || button.classList.contains("pending")) return;
    button.classList.add("pending");
    await this.acts.choose(this.name, name, this.revision);
    button.classList.remove("pending");
  }

  outcome({ done, text }) {
    this.outcomeShown = { done, text: text.replace(`${this.name}: `, ""), at: performance.now() };
    if (this.car) this.updateNote(this.car);
  }

  /// Adds this moment to the history, twice a second.
  updateSpark(car, draw) {
    const now = this.now;
    if (!now || (this.history.length && now - this.history.at(-1).at < 0.5)) return;
    const metrics = car.blind ? null : car.health?.metrics;
    this.history.push({
      at: now, state: car.state, alignment: metrics?.alignment ?? null, slip: metrics?.slip ?? null,
      spread_along: metrics?.spread_along ?? null, spread_across: metrics?.spread_across ?? null,
    });
    while (this.history[0].at < now - SPAN_S) this.history.shift();
    if (draw) plot(this.spark, this.history, now, { value: (p) => p.alignment, low: 0, high: 1, limits: [0.7, 0.45] });
  }
}
