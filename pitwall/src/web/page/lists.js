// The log, the laps, and every number of the selected car.

import { colourOf, element, fixed, missing, recorderText } from "/cards.js";

const SEVERITIES = ["info", "warning", "critical"];
const LONGEST = 500;

/// The list of events, with alarms that stay until somebody acknowledges them, on whichever page.
export class Log {
  constructor(list, alarm, filterCar, filterSeverity, sound, spoken) {
    this.spoken = spoken;
    this.list = list;
    this.alarm = alarm;
    this.filterCar = filterCar;
    this.filterSeverity = filterSeverity;
    this.sound = sound;
    this.restart();
    filterCar.addEventListener("change", () => this.redraw());
    filterSeverity.addEventListener("change", () => this.redraw());
  }

  /// Adds new entries. Those up to number `acknowledged` are no longer alarms.
  add(entries, acknowledged, first, open = []) {
    if (first) entries = [...open.filter((entry) => !entries.some((other) => other.number === entry.number)), ...entries];
    if (acknowledged !== this.acknowledged) {
      this.acknowledged = acknowledged;
      for (const line of this.list.querySelectorAll("li.open")) {
        if (Number(line.dataset.number) <= acknowledged) line.classList.remove("open");
      }
    }
    let alarm = false;
    for (const entry of entries) {
      if (entry.number <= this.last) continue;
      this.last = entry.number;
      this.entries.push(entry);
      // The oldest that is no open alarm goes.
      if (this.entries.length > LONGEST) this.entries.splice(Math.max(this.entries.findIndex((other) => !this.open(other)), 0), 1);
      alarm ||= !first && this.open(entry);
      if (this.wanted(entry)) this.show(entry);
    }
    for (let line = this.list.lastChild; line && this.list.children.length > LONGEST;) {
      const before = line.previousSibling;
      if (!line.classList.contains("open")) line.remove();
      line = before;
    }
    if (alarm) {
      this.sound.alarm();
      this.spoken.textContent = this.text(entries.findLast((entry) => this.open(entry)));
    }
    const count = this.entries.filter((entry) => this.open(entry)).length;
    if (count !== this.count) {
      this.count = count;
      this.alarm.hidden = count === 0;
      this.alarm.textContent = count === 1 ? "1 alarm" : `${count} alarms`;
    }
  }

  open(entry) { return entry.severity === "critical" && entry.number > this.acknowledged; }

  /// Adds an entry, the newest at the top. One that repeats the entry below it is counted there.
  show(entry) {
    // Late entries are sorted in by time.
    let below = this.list.firstChild;
    while (below && Number(below.dataset.at) > entry.at) below = below.nextSibling;
    const text = this.text(entry);
    if (below && below.dataset.text === text && !this.open(entry)) {
      below.dataset.count = Number(below.dataset.count) + 1;
      below.lastChild.textContent = `×${below.dataset.count}`;
      return;
    }
    const marker = entry.kind === "marker" ? " marker" : "";
    const line = element("li", `${entry.severity}${this.open(entry) ? " open" : ""}${marker}`);
    line.dataset.text = text;
    line.dataset.count = 1;
    line.dataset.number = entry.number;
    line.dataset.at = entry.at;
    const time = new Date(entry.at / 1e6).toTimeString().slice(0, 8);
    line.append(element("time", "", time), text, element("b"));
    this.list.insertBefore(line, below);
  }

  text(entry) {
    const mark = entry.kind === "marker" ? "⚑ " : "";
    return `${mark}${entry.car ? `${entry.car} ` : ""}${entry.text}${entry.who ? ` [${entry.who}]` : ""}`;
  }

  wanted(entry) {
    return (!this.filterCar.value || entry.car === this.filterCar.value)
      && SEVERITIES.indexOf(entry.severity) >= Number(this.filterSeverity.value);
  }

  redraw() {
    this.list.replaceChildren();
    for (const entry of this.entries) if (this.wanted(entry)) this.show(entry);
  }

  /// Clears the list.
  restart() {
    this.last = 0;
    this.entries = [];
    this.acknowledged = 0;
    this.count = 0;
    this.alarm.hidden = true;
    this.redraw();
  }
}

const rowOf = (tag, cells) => {
  const row = element("tr");
  for (const [text, className, title] of cells) {
    const cell = element(tag, className, text);
    if (title) cell.title = title;
    row.append(cell);
  }
  return row;
};

/// Best and last laps of all cars, the fastest first.
export function showStandings(table, cars, select) {
  const known = cars.map((car, index) => ({ ...car, index }));
  known.sort((a, b) => (a.best_lap_s ?? Infinity) - (b.best_lap_s ?? Infinity));
  const key = JSON.stringify(known.map((car) => [car.car, car.best_lap_s, car.last_lap_s, car.pose?.lap]));
  if (table.dataset.key === key) return;
  table.dataset.key = key;
  const lead = known[0]?.best_lap_s;
  const head = element("thead");
  head.append(rowOf("th", [["", ""], ["car", ""], ["best", "number"], ["behind", "number"], ["last", "number"], ["lap", "number"]]));
  const body = element("tbody");
  known.forEach((car) => {
    const row = rowOf("td", [["", ""], [car.car, ""], [fixed(car.best_lap_s, 3), "number"],
      [car.best_lap_s ? `+${fixed(car.best_lap_s - lead, 3)}` : "–", "number"], [fixed(car.last_lap_s, 3), "number"], [fixed(car.pose?.lap, 0), "number"]]);
    const chip = element("span", "chip");
    chip.style.background = colourOf(car.index);
    row.firstChild.append(chip);
    row.addEventListener("click", () => select(car.car));
    body.append(row);
  });
  table.replaceChildren(head, body);
}

/// Laps of the selected car with their sectors, the last first.
export function showLaps(table, laps, car) {
  const key = `${car}:${laps.length}:${laps.at(-1)?.lap}`;
  if (table.dataset.key === key) return;
  table.dataset.key = key;
  const best = Math.min(...laps.filter((lap) => !lap.void).map((lap) => lap.time_s));
  const sectors = [0, 1, 2].map((i) => Math.min(...laps.map((lap) => lap.sectors_s[i] ?? Infinity)));
  const head = rowOf("th", [[car ?? "", ""], ["time", "number"], ["to best", "number"], ["S1", "number"], ["S2", "number"], ["S3", "number"], ["set", ""],
    ["slip", "number", "share of the lap in which wheels slipped by more than 8 %"]]);
  const rows = laps.map((lap) => {
    const { grip } = lap;
    const slips = grip && grip.slipping > 0.1;
    const about = grip ? `worst slip ${fixed(grip.worst_slip * 100, 0)} %, mean alignment ${fixed(grip.alignment * 100, 0)} %, mean distance from the raceline ${fixed(lap.lateral_m && lap.lateral_m * 100, 1)} cm` : "";
    return rowOf("td", [
      [String(lap.lap), "number"], [fixed(lap.time_s, 3), `number${lap.void ? " void" : lap.time_s === best ? " best" : ""}`, lap.void ?? ""], [lap.void ? "void" : `+${fixed(lap.time_s - best, 3)}`, "number", lap.void ?? ""],
      ...lap.sectors_s.map((s, i) => [fixed(s, 2), `number${s !== null && s === sectors[i] ? " best" : ""}`]),
      [lap.set, "set", lap.set], [grip ? `${slips ? "▲" : ""}${fixed(grip.slipping * 100, 0)} %` : "–", `number${slips ? " warn" : ""}`, about],
    ]);
  });
  table.replaceChildren(head, ...rows.reverse());
}

/// Metrics that are no shares and no counts.
const UNITS = {
  residual: " m", spread_along: " m", spread_across: " m", innovation: " m", innovation_angle: " rad", yaw_rate_residual: " rad/s", age_p50: " s", age_p99: " s",
};

/// What the metrics mean whose names do not say it.
const MEANING = {
  alignment: "share of the beams that end within 10 cm of a wall of the map, or 5 cm and a cell",
  residual: "mean distance of the beams' ends from the nearest wall",
  short_beams: "share of the beams more than 0.3 m shorter than in the map",
  long_beams: "share of the beams more than 0.3 m longer than in the map",
  no_return: "share of the beams that saw nothing",
  ess_ratio: "effective sample size over the number of particles: low when few particles explain the scan",
  w_ratio: "how well scans have fitted lately, over how well they usually do: 1 as usual",
  spread_along: "standard deviation of the particles along the track",
  spread_across: "standard deviation of the particles across the track",
  second_mode: "mass of the second cluster of particles over that of the first: near 1 when two places look alike",
  slip: "share of odometry's distance that was not driven: positive when wheels spin, negative when they lock",
  yaw_rate_residual: "odometry's yaw rate less that of the pose",
  innovation: "distance by which the last scan corrected the pose",
  innovation_angle: "angle by which the last scan corrected the pose",
  age_p50: "age of the pose, median of the last scans",
  age_p99: "age of the pose, the oldest in a hundred",
};

/// Every number that the selected car has sent.
export function showNumbers(table, car, pace) {
  const rows = [];
  const add = (name, value, meaning) => rows.push([name, value, meaning]);
  if (car) {
    if (car.pose) {
      add("x, y", `${fixed(car.pose.x_m, 3)}, ${fixed(car.pose.y_m, 3)} m`);
      add("heading", fixed(car.pose.heading_rad * 180 / Math.PI, 1, "°"));
      add("s, d", `${fixed(car.pose.s_m, 2)}, ${fixed(car.pose.d_m, 3)} m`, "distance along the raceline, and to its left");
    }
    if (car.set) add("set", `${car.set.name}, revision ${car.set.revision} by ${car.set.who}`);
    for (const [name, value] of Object.entries(car.health?.metrics ?? {})) add(name.replaceAll("_", " "), fixed(value, name === "particles" ? 0 : 3, UNITS[name]), MEANING[name]);
    if (car.load) {
      add("update p50 / p99 / max", ["p50", "p99", "max"].map((k) => fixed(car.load.update_us[k] / 1e3, 2)).join(" / ") + " ms");
      add("scan age p50 / p99", ["p50", "p99"].map((k) => fixed(car.load.scan_age_us[k] / 1e3, 1)).join(" / ") + " ms");
      add("scans, odometry", `${fixed(car.load.scan_rate, 1)}, ${fixed(car.load.odometry_rate, 1)} /s`);
      add("memory", fixed(car.load.memory_process / 1e6, 0, " MB"));
      add("queue", String(car.load.queue_depth));
      if (car.load.recorder) add("on the car", recorderText(car.load.recorder));
      for (const [name, count] of Object.entries(car.load.drops)) if (count) add(`dropped: ${name.replaceAll("_", " ")}`, String(count));
    }
    const ms = (s) => fixed(s && s * 1e3, 2);
    add("clock offset", car.clock_offset_s == null ? "-" : `${ms(car.clock_offset_s)} ± ${ms(car.clock_uncertainty_s)} ms`);
    add("missing", String(missing(car)));
    for (const [topic, s] of Object.entries(car.streams)) {
      add(topic, `${fixed(s.rate_hz, 1)} /s, age ${fixed(s.age_s, 2)} s, missing ${s.missing}${s.filled_late ? `, recovered ${s.filled_late}` : ""}${s.unreadable ? `, unreadable ${s.unreadable}` : ""}`);
    }
    if (car.info) {
      add("source", car.info.source);
      add("map", car.info.map);
      add("version, host", `${car.info.version}, ${car.info.host}`);
    }
  }
  add("this page", pace);
  table.replaceChildren(...rows.map(([name, value, meaning]) => rowOf("td", [[name, "quiet", meaning], [value, "", meaning]])));
}
