// What happened, the laps, and every number of the selected car.

import { fixed } from "/cards.js";

const SEVERITIES = ["info", "warning", "critical"];
const LONGEST = 500;

const element = (tag, className, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
};

/// The list of events, with alarms that stay until they are acknowledged.
export class Log {
  constructor(list, alarm, filterCar, filterSeverity) {
    this.list = list;
    this.alarm = alarm;
    this.filterCar = filterCar;
    this.filterSeverity = filterSeverity;
    this.entries = [];
    this.last = 0;
    this.open = 0;
    filterCar.addEventListener("change", () => this.redraw());
    filterSeverity.addEventListener("change", () => this.redraw());
  }

  add(entries, first) {
    for (const entry of entries) {
      if (entry.number <= this.last) continue;
      this.last = entry.number;
      this.entries.push(entry);
      if (this.entries.length > LONGEST) this.entries.shift();
      // What happened before the page was opened is history, not an alarm.
      entry.fresh = !first && entry.severity === "critical";
      if (entry.fresh) this.open += 1;
      if (this.wanted(entry)) this.show(entry);
    }
    while (this.list.children.length > LONGEST) this.list.lastChild.remove();
    this.showAlarms();
  }

  /// Adds a line at the top; one that says the same as the one below it is counted there.
  show(entry) {
    const top = this.list.firstChild;
    const text = this.text(entry);
    if (top && top.dataset.text === text && !entry.fresh) {
      top.dataset.count = Number(top.dataset.count) + 1;
      top.lastChild.textContent = `×${top.dataset.count}`;
      return;
    }
    const line = element("li", `${entry.severity}${entry.fresh ? " new" : ""}`);
    line.dataset.text = text;
    line.dataset.count = 1;
    const time = new Date(entry.at / 1e6).toTimeString().slice(0, 8);
    line.append(element("time", "", time), text, element("b"));
    this.list.prepend(line);
  }

  text(entry) {
    return `${entry.car ?? ""} ${entry.text}${entry.who ? ` [${entry.who}]` : ""}`;
  }

  wanted(entry) {
    return (!this.filterCar.value || entry.car === this.filterCar.value)
      && SEVERITIES.indexOf(entry.severity) >= Number(this.filterSeverity.value);
  }

  redraw() {
    this.list.replaceChildren();
    for (const entry of this.entries) if (this.wanted(entry)) this.show(entry);
  }

  showAlarms() {
    this.alarm.hidden = this.open === 0;
    this.alarm.textContent = this.open === 1 ? "1 alarm" : `${this.open} alarms`;
  }

  acknowledge() {
    this.open = 0;
    for (const entry of this.entries) entry.fresh = false;
    this.redraw();
    this.showAlarms();
  }

  /// A new page of the program begins a new log.
  restart() { this.last = 0; this.entries = []; this.redraw(); }
}

/// Laps of the selected car, the last first.
export function showLaps(table, laps, car) {
  const key = `${car}:${laps.length}`;
  if (table.dataset.key === key) return;
  table.dataset.key = key;
  const best = Math.min(...laps.map((lap) => lap.time_s));
  const row = (tag, className, cells) => {
    const made = element("tr", className);
    cells.forEach((text, i) => made.append(element(tag, i === 3 ? "" : "number", text)));
    return made;
  };
  const rows = laps.map((lap) =>
    row("td", lap.time_s === best ? "best" : "", [String(lap.lap), fixed(lap.time_s, 3), `+${fixed(lap.time_s - best, 3)}`, lap.set]));
  table.replaceChildren(row("th", "", [`lap of ${car ?? "–"}`, "time s", "to best", "set"]), ...rows.reverse());
}

/// Every number that the selected car has sent.
export function showNumbers(table, car) {
  const rows = [];
  const add = (name, value) => rows.push([name, value]);
  if (car) {
    if (car.pose) {
      add("x, y", `${fixed(car.pose.x_m, 3)}, ${fixed(car.pose.y_m, 3)} m`);
      add("heading", fixed(car.pose.heading_rad * 180 / Math.PI, 1, "°"));
      add("s, d", `${fixed(car.pose.s_m, 2)}, ${fixed(car.pose.d_m, 3)} m`);
    }
    for (const [name, value] of Object.entries(car.health?.metrics ?? {})) add(name.replaceAll("_", " "), fixed(value, name === "particles" ? 0 : 3));
    if (car.load) {
      add("update p50 / p99 / max", ["p50", "p99", "max"].map((k) => fixed(car.load.update_us[k] / 1e3, 2)).join(" / ") + " ms");
      add("scan age p50 / p99", ["p50", "p99"].map((k) => fixed(car.load.scan_age_us[k] / 1e3, 1)).join(" / ") + " ms");
      add("scans, odometry", `${fixed(car.load.scan_rate, 1)}, ${fixed(car.load.odometry_rate, 1)} /s`);
      add("memory", fixed(car.load.memory_process / 1e6, 0, " MB"));
      add("queue", String(car.load.queue_depth));
      for (const [name, count] of Object.entries(car.load.drops)) if (count) add(`dropped: ${name.replaceAll("_", " ")}`, String(count));
    }
    add("clock offset", fixed(car.clock_offset_s && car.clock_offset_s * 1e3, 2, " ms"));
    for (const [topic, s] of Object.entries(car.streams)) {
      add(topic, `${fixed(s.rate_hz, 1)} /s, missing ${s.missing}${s.filled_late ? `, late ${s.filled_late}` : ""}${s.unreadable ? `, unreadable ${s.unreadable}` : ""}`);
    }
    if (car.info) {
      add("source", car.info.source);
      add("map", car.info.map);
      add("version, host", `${car.info.version}, ${car.info.host}`);
    }
  }
  table.replaceChildren(...rows.map(([name, value]) => {
    const row = element("tr");
    row.append(element("th", "", name), element("td", "", value));
    return row;
  }));
}
