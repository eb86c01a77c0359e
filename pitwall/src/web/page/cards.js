// The cars' cards. Elements are made once and then only their text changes.

/// Word, shape, colour class and meaning of each state. Shape and word carry what the colour does.
export const STATES = {
  INIT: ["○", "none", "no pose yet"],
  CONVERGING: ["◐", "busy", "a pose, not yet confirmed"],
  LOCALIZED: ["●", "good", "the pose can be raced on"],
  DEGRADED: ["▲", "warn", "the pose is probably right; something is wrong"],
  LOST: ["✖", "bad", "the pose is wrong"],
  RELOCALIZING: ["↻", "busy", "searching the whole map"],
  STALE: ["■", "bad", "no sensor data on the car"],
  BLIND: ["□", "none", "nothing comes from the car"],
};

const COLOURS = ["#5aa9ff", "#ff9d5c", "#b98cff", "#2fd0c8", "#ff6fae", "#d8d84a", "#7fd46b", "#e07a5f", "#9fb4ff", "#c0a080"];

/// A car's own colour, by its place in the list.
export const colourOf = (index) => COLOURS[index % COLOURS.length];

export const fixed = (value, digits, unit = "") =>
  value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits) + unit;

const element = (tag, className, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
};

const setText = (node, text) => { if (node.textContent !== text) node.textContent = text; };

const FACTS = [
  ["speed", (c) => fixed(c.pose?.speed_mps, 1, " m/s")],
  ["age", (c) => fixed(c.pose && c.pose.age_s * 1e3, 0, " ms"), (c) => c.pose?.age_s > 0.15],
  ["alignment", (c) => fixed(c.health?.metrics && c.health.metrics.alignment * 100, 0, " %"), (c) => c.health?.metrics?.alignment < 0.7],
  ["slip", (c) => fixed(c.health?.metrics && c.health.metrics.slip * 100, 0, " %"), (c) => Math.abs(c.health?.metrics?.slip) > 0.08],
  ["last lap", (c) => fixed(c.last_lap_s, 2, " s")],
  ["best lap", (c) => fixed(c.best_lap_s, 2, " s")],
  ["poses", (c) => fixed(c.streams.pose?.rate_hz, 0, " /s")],
  ["RTT", (c) => fixed(c.round_trip_s && c.round_trip_s * 1e3, 1, " ms"), (c) => c.round_trip_s > 0.1],
  ["update p99", (c) => fixed(c.load && c.load.update_us.p99 / 1e3, 2, " ms"), (c) => c.load?.update_us.p99 > 10e3],
  ["CPU", (c) => fixed(c.load && c.load.cpu_process * 100, 0, " %")],
  ["temp", (c) => fixed(c.load?.temperature, 0, " °C"), (c) => c.load?.temperature > 80],
  ["missing", (c) => String(Object.values(c.streams).reduce((sum, s) => sum + s.missing, 0))],
];

/// All cards. `act(car, action, expected)` gives a command, `select(car)` selects.
export class Cards {
  constructor(root, act, select) {
    this.root = root;
    this.act = act;
    this.select = select;
    this.cards = new Map();
  }

  update(cars, selected) {
    this.root.classList.toggle("many", cars.length > 4);
    cars.forEach((car, index) => {
      let card = this.cards.get(car.car);
      if (!card) {
        card = new Card(car.car, index, this.act, this.select);
        this.cards.set(car.car, card);
        this.root.append(card.root);
      }
      card.update(car, car.car === selected);
    });
  }

  outcome(car, result) { this.cards.get(car)?.outcome(result); }
}

class Card {
  constructor(name, index, act, select) {
    this.name = name;
    this.act = act;
    this.root = element("article", "card");
    this.root.tabIndex = 0;
    this.root.dataset.car = name;
    this.root.addEventListener("click", () => select(name));
    this.root.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target === this.root) select(name);
    });
    const head = element("header");
    const chip = element("span", "chip");
    chip.style.background = colourOf(index);
    this.since = element("span", "for");
    this.state = element("span", "state");
    head.append(chip, element("span", "name", name), this.state, this.since);
    this.causes = element("ul", "causes");
    const detail = element("div", "detail");
    const facts = element("div", "facts");
    this.facts = FACTS.map(([label]) => {
      const cell = element("div");
      const value = element("b");
      cell.append(element("span", "", label), value);
      facts.append(cell);
      return value;
    });
    this.spark = element("canvas", "spark");
    this.history = [];
    this.sets = element("div", "sets");
    this.setButtons = new Map();
    this.proposal = element("div", "proposal");
    this.revert = element("div", "revert");
    this.result = element("p", "outcome");
    this.result.setAttribute("role", "status");
    detail.append(facts, this.spark, this.sets, this.revert, this.proposal, this.result);
    this.root.append(head, this.causes, detail);
  }

  update(car, selected) {
    const [shape, colour] = STATES[car.state] ?? ["?", "none"];
    const className = `card ${colour}${car.blind ? " blind" : ""}${selected ? " selected" : ""}`;
    if (this.root.className !== className) this.root.className = className;
    setText(this.state, `${shape} ${car.state}`);
    setText(this.since, car.blind ? `silent for ${fixed(car.quiet_s, 0)} s` : `for ${fixed(car.state_for_s, 0)} s`);
    const causes = car.causes.join("\n");
    if (this.causes.dataset.text !== causes) {
      this.causes.dataset.text = causes;
      this.causes.replaceChildren(...car.causes.map((cause) => element("li", "", cause)));
    }
    FACTS.forEach(([, text, off], i) => {
      setText(this.facts[i], text(car));
      this.facts[i].classList.toggle("off", Boolean(off?.(car)));
    });
    this.updateSets(car);
    this.updateSpark(car);
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
        const button = element("button", "", name);
        button.dataset.set = name;
        button.addEventListener("click", (event) => {
          event.stopPropagation();
          this.choose(name);
        });
        this.setButtons.set(name, button);
        return button;
      }));
    }
    for (const [name, button] of this.setButtons) button.setAttribute("aria-pressed", String(name === set?.name));
    this.revision = set?.revision ?? null;
    const revert = set?.reverts_to ? `falls back to ${set.reverts_to} in ${fixed(set.reverts_in_s, 0)} s unless confirmed (c)` : "";
    setText(this.revert, revert);
    const proposal = car.health?.proposal;
    setText(this.proposal, proposal ? `proposes ${proposal.set}: ${proposal.evidence}` : car.health?.auto ? "switches sets by itself" : "");
  }

  /// Puts a set in force, if the one that is seen here still is.
  async choose(name) {
    const button = this.setButtons.get(name);
    if (!button || button.classList.contains("pending")) return;
    button.classList.add("pending");
    await this.act(this.name, { params: { select: { name, revert_after_ms: null } } }, this.revision);
    button.classList.remove("pending");
  }

  outcome({ done, text }) {
    this.result.className = `outcome ${done === null ? "" : done ? "done" : "failed"}`;
    setText(this.result, (done === null ? "… " : done ? "✓ " : "✗ ") + text);
  }

  /// Alignment over the last minute.
  updateSpark(car) {
    const now = performance.now();
    if (this.history.length && now - this.history.at(-1)[0] < 250) return;
    const alignment = car.blind ? null : car.health?.metrics?.alignment ?? null;
    this.history.push([now, alignment, car.state]);
    while (this.history[0][0] < now - 60e3) this.history.shift();
    const canvas = this.spark;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const style = getComputedStyle(document.documentElement);
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.lineWidth = 2;
    for (let i = 1; i < this.history.length; i++) {
      const [t0, a0] = this.history[i - 1], [t1, a1, state] = this.history[i];
      if (a0 === null || a1 === null) continue;
      context.strokeStyle = style.getPropertyValue(`--${(STATES[state] ?? STATES.INIT)[1]}`);
      context.beginPath();
      context.moveTo(width - (now - t0) / 60e3 * width, height - 2 - a0 * (height - 4));
      context.lineTo(width - (now - t1) / 60e3 * width, height - 2 - a1 * (height - 4));
      context.stroke();
    }
  }
}
