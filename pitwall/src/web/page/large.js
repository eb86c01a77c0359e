// The large view of one car in the middle of the page: all causes, figures, two minutes of history, every set.

import { plot } from "/chart.js";
import { FACTS, STATES, recorderText, colourOf, element, fixed, missing, lasting, setText, verdict } from "/cards.js";

const MORE = [
  ["spread along", (c) => fixed(c.health?.metrics?.spread_along, 3, " m"), (c) => c.health?.metrics?.spread_along > 0.4],
  ["spread across", (c) => fixed(c.health?.metrics?.spread_across, 3, " m"), (c) => c.health?.metrics?.spread_across > 0.15],
  ["residual", (c) => fixed(c.health?.metrics?.residual, 3, " m"), (c) => c.health?.metrics?.residual > 0.18],
  ["off the line", (c) => fixed(c.pose?.d_m, 2, " m")],
  ["missing", (c) => String(missing(c))],
  ["lap", (c) => fixed(c.pose?.lap, 0)],
  ["memory", (c) => fixed(c.load && c.load.memory_process / 1e6, 0, " MB")],
  ["on the car", (c) => !c.load?.recorder ? "–" : c.load.recorder.error ? "FAILS" : c.load.recorder.recording ? "recording" : "not recording", (c) => c.load?.recorder?.error || c.load?.recorder?.dropped > 0],
];

const CHARTS = [
  ["alignment (limits 0.70 and 0.45)", { value: (p) => p.alignment, low: 0, high: 1, limits: [0.7, 0.45] }],
  ["slip, ±50 % (limits 8 and 20 %)", { value: (p) => p.slip, low: -0.5, high: 0.5, limits: [0.08, 0.2, -0.08, -0.2] }],
  ["spread along, to 1 m (limit 0.4)", { value: (p) => p.spread_along, low: 0, high: 1, limits: [0.4] }],
  ["across, to 0.5 m (limit 0.15)", { value: (p) => p.spread_across, low: 0, high: 0.5, limits: [0.15] }],
];

/// The comparison of two sets, row by row.
const ROWS = [
  ["alignment", (f) => fixed(f.alignment, 3)],
  ["residual", (f) => fixed(f.residual, 4, " m")],
  ["correction per scan", (f) => fixed(f.innovation, 4, " m")],
  ["spread along, across", (f) => `${fixed(f.spread_along, 3)}, ${fixed(f.spread_across, 3)} m`],
  ["update p50, p99", (f) => `${fixed(f.update_us.p50 / 1e3, 2)}, ${fixed(f.update_us.p99 / 1e3, 2)} ms`],
];

export class Large {
  /// `acts` as for the cards, and close().
  constructor(root, acts) {
    this.root = root;
    this.acts = acts;
    const headline = element("div", "headline");
    this.chip = element("span", "chip");
    this.name = element("span");
    this.state = element("span", "state");
    this.since = element("span", "for");
    const close = element("button", "", "close (Esc)");
    close.addEventListener("click", () => acts.close());
    this.recorder = element("button");
    this.recorder.addEventListener("click", () => acts.record(this.car, this.recorder.getAttribute("aria-pressed") !== "true"));
    headline.append(this.chip, this.name, this.state, this.since, this.recorder, close);
    if (acts.beside) {
      this.others = element("select");
      this.others.setAttribute("aria-label", "Another car beside it");
      this.others.addEventListener("change", () => acts.beside(this.others.value || null));
      close.before(this.others);
    }
    this.sheet = element("p", "verdict");
    this.causes = element("ul");
    const big = element("div", "big");
    this.facts = [...FACTS, ...MORE].map(([label, text, off]) => {
      const cell = element("div");
      const value = element("b");
      cell.append(element("span", "", label), value);
      big.append(cell);
      return [value, text, off];
    });
    const charts = element("div", "charts");
    this.charts = CHARTS.map(([title, options]) => {
      const figure = element("figure");
      const canvas = element("canvas");
      figure.append(element("figcaption", "", title), canvas);
      charts.append(figure);
      return [canvas, options];
    });
    this.sets = element("table");
    this.verdict = element("p", "verdict");
    this.comparison = element("table");
    root.append(headline, this.causes, this.sheet, big, charts, element("h2", "", "Sets"), this.sets, this.verdict, this.comparison);
  }

  update(car, index, history, now) {
    const [shape, colour] = STATES[car.state] ?? ["?", "none"];
    if (this.root.className !== colour) this.root.className = colour;
    this.chip.style.background = colourOf(index);
    setText(this.name, car.car);
    setText(this.state, `${shape} ${car.state}`);
    setText(this.since, car.blind ? `silent for ${lasting(car.quiet_s)}` : `for ${lasting(car.state_for_s)}`);
    setText(this.sheet, car.run_sheet ? `run sheet: ${car.run_sheet}` : "");
    this.offerOthers(car.car);
    const causes = car.causes.join("\n");
    if (this.causes.dataset.text !== causes) {
      this.causes.dataset.text = causes;
      this.causes.replaceChildren(...car.causes.map((cause) => element("li", "", cause)));
    }
    for (const [value, text, off] of this.facts) {
      setText(value, text(car));
      value.classList.toggle("off", Boolean(off?.(car)));
    }
    if (history.at(-1) !== this.last) {
      this.last = history.at(-1);
      for (const [canvas, options] of this.charts) plot(canvas, history, now, options);
    }
    this.car = car.car;
    this.updateRecorder(car.load?.recorder);
    this.updateSets(car);
    this.updateShadow(car);
  }

  /// The recording on the car's own disk.
  updateRecorder(state) {
    this.recorder.hidden = !state;
    if (!state) return;
    this.recorder.setAttribute("aria-pressed", String(state.recording));
    setText(this.recorder, state.recording ? "■ stop recording on the car" : "● record on the car");
    this.recorder.title = recorderText(state);
  }

  /// The cars that can be shown beside this one.
  offerOthers(name) {
    if (!this.others) return;
    const wanted = ["", ...this.acts.cars().filter((car) => car !== name)];
    if ([...this.others.options].map((option) => option.value).join() === wanted.join()) return;
    const value = this.others.value;
    this.others.replaceChildren(...wanted.map((car) => new Option(car ? `beside: ${car}` : "beside: none", car)));
    this.others.value = wanted.includes(value) ? value : "";
    if (this.others.value !== value) this.acts.beside(null);
  }

  updateSets(car) {
    const set = car.set;
    const key = JSON.stringify([car.car, set?.reverts_to, set?.name, set?.revision, set?.available, car.shadow?.set]);
    if (this.sets.dataset.key === key) return;
    this.sets.dataset.key = key;
    const button = (text, act) => {
      const made = element("button", "", text);
      made.addEventListener("click", act);
      const cell = element("td");
      cell.append(made);
      return cell;
    };
    this.sets.replaceChildren(...(set?.available ?? []).map((name) => {
      const row = element("tr", name === set.name ? "force" : "");
      row.append(element("td", "", name));
      if (name === set.name) {
        row.append(element("td", "", `in force, revision ${set.revision}, by ${set.who}`), button("back to the one before", () => this.acts.revert(car.car)));
        if (set.reverts_to) row.append(button("confirm", () => this.acts.confirm(car.car)));
      } else {
        row.append(button("put in force", () => this.acts.choose(car.car, name, set.revision)));
        row.append(button("try for 60 s", () => this.acts.trial(car.car, name, set.revision)));
        const runs = car.shadow?.set === name;
        row.append(button(runs ? "end the shadow" : "run in the shadow", () => this.acts.shadow(car.car, runs ? null : name)));
      }
      return row;
    }));
  }

  updateShadow(car) {
    const shadow = car.shadow;
    setText(this.verdict, shadow ? verdict(shadow) : "");
    const c = shadow?.comparison;
    const key = JSON.stringify(c ?? null);
    if (this.comparison.dataset.key === key) return;
    this.comparison.dataset.key = key;
    if (!c) { this.comparison.replaceChildren(); return; }
    const row = (tag, cells) => {
      const made = element("tr");
      cells.forEach((text, i) => made.append(element(tag, i ? "number" : "", text)));
      return made;
    };
    this.comparison.replaceChildren(
      row("th", [`last ${fixed(c.window, 0)} s, ${c.scans} scans`, `${c.in_force.name} (in force)`, `${shadow.set} (shadow)`]),
      ...ROWS.map(([label, text]) => row("td", [label, text(c.force), text(c.shadow)])),
      row("td", ["fits better in", fixed(c.force_better * 100, 0, " %"), fixed(c.shadow_better * 100, 0, " %")]),
    );
  }
}
