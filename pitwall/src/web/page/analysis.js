// Laps over the track, health over the track, and where the map is wrong. The live page, a replay and the report use it.

const COLOURS = ["#5aa9ff", "#ff9d5c", "#b98cff", "#2fd0c8", "#ff6fae", "#c9c93a", "#7fd46b", "#e07a5f", "#9fb4ff", "#c0a080"];
/// Plots that are open at first.
const OPEN = ["delta", "speed", "lateral", "heading_error", "alignment", "slip"];
const MOST_LAPS = COLOURS.length;
/// Colours of the heat-map from good to bad.
const HEAT = [[24, 40, 74], [32, 98, 130], [64, 160, 150], [240, 180, 60], [255, 80, 80]];
const LEFT = 52, TITLE = 17, BELOW = 4;
const WRONG = {
  moved: "the wall stands elsewhere",
  not_drawn: "a wall is missing in the map",
  not_there: "the map draws a wall that is not there",
};

const make = (tag, className, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
};
const button = (text, title, act) => {
  const made = make("button", "", text);
  made.type = "button";
  made.title = title;
  made.addEventListener("click", act);
  return made;
};
const digits = (value, count) => (Number.isFinite(value) ? value.toFixed(count) : "–");
const signed = (value, count) => (Number.isFinite(value) ? `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(count)}` : "–");
const clock = (ns) => new Date(ns / 1e6).toTimeString().slice(0, 8);

/// A colour of the theme that is shown, resolved by the browser. Asking for each would take longer than drawing.
const themed = { key: "", colours: new Map(), probe: null };
function theme(name) {
  const key = `${document.documentElement.dataset.theme} ${matchMedia("(prefers-color-scheme: dark)").matches}`;
  if (themed.key !== key) [themed.key, themed.colours] = [key, new Map()];
  let colour = themed.colours.get(name);
  if (!colour) {
    themed.probe ??= document.body.appendChild(make("i", "an-probe"));
    themed.probe.style.color = `var(--${name})`;
    colour = getComputedStyle(themed.probe).color;
    themed.colours.set(name, colour);
  }
  return colour;
}

function bytes(text) {
  const raw = atob(text);
  const made = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) made[i] = raw.charCodeAt(i);
  return made.buffer;
}

/// The numbers of a lap: seconds at each edge of a cell, and each channel in its own unit; NaN where not known.
function unpack(data, channels) {
  const edges = Float64Array.from(new Int32Array(bytes(data.edges)), (v) => (v === -2147483648 ? NaN : v * 1e-4));
  const values = {};
  for (const { name, step } of channels) {
    if (data.channels[name]) values[name] = Float32Array.from(new Int16Array(bytes(data.channels[name])), (v) => (v === -32768 ? NaN : v * step));
  }
  return { edges, values, causes: data.causes, states: data.states };
}

/// Offers a file for download.
function save(name, content, kind) {
  const link = make("a");
  link.href = typeof content === "string" && content.startsWith("data:") ? content : URL.createObjectURL(new Blob([content], { type: kind }));
  link.download = name;
  link.click();
  if (link.href.startsWith("blob:")) setTimeout(() => URL.revokeObjectURL(link.href), 10e3);
}

/// About five round numbers in a range.
/// By a lap's id, what to add to its name: the run, where the car has begun to count its laps anew in a session.
function runsOf(laps) {
  const cars = new Map();
  for (const lap of [...laps].sort((a, b) => a.begun - b.begun)) {
    const key = `${lap.session}/${lap.car}`;
    const runs = cars.get(key) ?? [[]];
    const last = runs.at(-1).at(-1);
    if (last && lap.lap <= last.lap) runs.push([]);
    runs.at(-1).push(lap);
    cars.set(key, runs);
  }
  const several = [...cars.values()].filter((runs) => runs.length > 1);
  return new Map(several.flatMap((runs) => runs.flatMap((run, i) => run.map((lap) => [lap.id, `, run ${i + 1}`]))));
}

function ticks(low, high) {
  const raw = (high - low) / 4;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw);
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(v);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

function fit(canvas, height) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth;
  if (height && canvas.style.height !== `${height}px`) canvas.style.height = `${height}px`;
  const tall = height || canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(tall * ratio)) canvas.height = Math.round(tall * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, tall);
  return [context, width, tall];
}

export class Analysis {
  /// `load(id)` resolves to a lap's data. `keep(track, borders)` keeps sectors and resolves to null or what is wrong with
  /// them; without it they stay on this page.
  constructor(root, { load, keep = null, extra = [] }) {
    Object.assign(this, { root, load, keep, view: null, laps: new Map(), data: new Map(), loading: new Set(), chosen: [], reference: null });
    Object.assign(this, { own: false, track: null, range: null, a: null, b: null, pinned: false, editing: false, mode: "laps", metric: "alignment", heatCar: "", shown: new Set(OPEN), finding: null, borders: null });
    root.classList.add("analysis");
    const side = make("section", "an-side");
    this.filter = make("select");
    this.filter.setAttribute("aria-label", "Laps of");
    this.filter.addEventListener("change", () => this.drawList());
    const bar = make("div", "an-bar");
    bar.append(this.filter, button("best of each", "the best lap of each car", () => { this.own = false; this.choose(); this.draw(); }), button("none", "choose no lap", () => { this.own = true; this.chosen = []; this.draw(); }), ...extra);
    this.list = make("table", "an-laps");
    const scroll = make("div", "an-scroll");
    scroll.append(this.list);
    side.append(bar, scroll);

    const middle = make("section", "an-middle");
    this.modes = make("div", "an-bar");
    this.modeButtons = [["laps", "laps over distance"], ["health", "health over the track"]].map(([mode, text]) => {
      const made = button(text, text, () => { this.mode = mode; this.draw(); });
      made.dataset.mode = mode;
      return made;
    });
    this.hint = make("span", "an-hint");
    this.hint.setAttribute("role", "status");
    this.modes.append(...this.modeButtons, button("whole lap", "show the whole lap (0)", () => this.zoomTo(null)), this.hint);
    this.channelBar = make("div", "an-bar an-channels");
    this.plots = make("div", "an-plots");
    this.plots.tabIndex = 0;
    this.plots.setAttribute("role", "group");
    this.plots.setAttribute("aria-label", "Plots over the track: arrow keys move the cursor, with Shift the second one");
    this.canvases = new Map();
    this.readout = make("table", "an-readout");
    const tableBox = make("div", "an-wide");
    tableBox.append(this.readout);
    this.heatBox = make("div", "an-heat");
    this.heatBar = make("div", "an-bar");
    this.heat = make("canvas");
    this.heat.setAttribute("aria-label", "Health over track and laps");
    this.heatText = make("p", "an-hint");
    this.heatText.setAttribute("role", "status");
    this.heatBox.append(this.heatBar, this.heat, this.heatText);
    middle.append(this.modes, this.channelBar, this.plots, tableBox, this.heatBox);
    this.tableBox = tableBox;

    const right = make("section", "an-right");
    this.map = make("canvas", "an-map");
    this.map.setAttribute("aria-label", "Track map");
    this.mapBar = make("div", "an-bar");
    this.edit = button("edit sectors", "add a border by a click on the track, remove one by a click on it", () => this.editSectors());
    this.mapBar.append(this.edit, this.findingBack = button("whole track", "show the whole track", () => { this.finding = null; this.drawMap(); }));
    this.sectors = make("table", "an-sectors");
    const sectorBox = make("div", "an-wide");
    sectorBox.append(this.sectors);
    this.findings = make("ol", "an-findings");
    this.advice = make("ol", "an-advice");
    right.append(this.map, this.mapBar, sectorBox, make("h3", "", "What limited the laps"), this.advice, make("h3", "", "The map is wrong here"), this.findings);
    root.append(side, middle, right);
    this.listen();
    new ResizeObserver(() => {
      root.classList.toggle("an-two", root.clientWidth < 1100);
      root.classList.toggle("an-one", root.clientWidth < 700);
      this.drawSoon();
    }).observe(root);
  }

  listen() {
    const at = (e) => {
      const box = this.plots.getBoundingClientRect();
      return this.sAt(e.clientX - box.left, this.plots.clientWidth);
    };
    let drag = null;
    this.plots.addEventListener("pointerdown", (e) => { if (e.button === 0 && this.view) drag = { s: at(e), x: e.clientX }; });
    this.plots.addEventListener("pointermove", (e) => {
      if (!this.trackOf()) return;
      if (drag && Math.abs(e.clientX - drag.x) > 8) this.selecting = [drag.s, at(e)];
      if (!this.pinned) this.a = at(e);
      this.drawSoon();
    });
    this.plots.addEventListener("pointerup", (e) => {
      if (!drag) return;
      const from = drag;
      drag = null;
      this.selecting = null;
      if (Math.abs(e.clientX - from.x) > 8) {
        this.zoomTo([Math.min(from.s, at(e)), Math.max(from.s, at(e))]);
      } else if (e.shiftKey) {
        this.b = at(e);
      } else {
        this.pinned = !this.pinned || this.a === null || Math.abs(at(e) - this.a) > 0.3;
        this.a = at(e);
      }
      this.drawSoon();
    });
    this.plots.addEventListener("dblclick", () => { this.b = null; this.zoomTo(null); });
    this.plots.addEventListener("wheel", (e) => {
      if (!this.trackOf() || e.ctrlKey) return;
      e.preventDefault();
      const [from, to] = this.span();
      const s = at(e), factor = e.deltaY > 0 ? 1.25 : 0.8;
      this.zoomTo([s - (s - from) * factor, s + (to - s) * factor]);
    }, { passive: false });
    this.plots.addEventListener("keydown", (e) => {
      const track = this.trackOf();
      if (!track || e.ctrlKey || e.altKey || e.metaKey) return;
      const move = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
      if (move) {
        const which = e.shiftKey ? "b" : "a";
        const from = this[which] ?? this.a ?? 0;
        this[which] = Math.min(Math.max(from + move * track.length / track.cells, 0), track.length);
        this.pinned = true;
        this.drawSoon();
      } else if (e.key === "0") {
        this.zoomTo(null);
      } else if (e.key === "+" || e.key === "-") {
        const [from, to] = this.span(), s = this.a ?? (from + to) / 2, factor = e.key === "-" ? 1.25 : 0.8;
        this.zoomTo([s - (s - from) * factor, s + (to - s) * factor]);
      } else return;
      e.preventDefault();
      e.stopPropagation();
    });
    this.map.addEventListener("click", (e) => this.mapClicked(e));
    this.map.addEventListener("pointermove", (e) => {
      const s = this.nearest(e);
      if (s !== null && !this.pinned) { this.a = s; this.drawSoon(); }
    });
    this.heat.addEventListener("pointermove", (e) => this.heatHover(e));
    this.heat.addEventListener("click", (e) => {
      const hit = this.heatHover(e);
      if (hit) this.toggle(hit.lap.id);
    });
  }

  /// Shows other data. Laps that were loaded stay.
  update(view) {
    const first = !this.view;
    this.view = view;
    this.laps = new Map(view.laps.map((lap) => [lap.id, lap]));
    this.runs = runsOf(view.laps);
    this.chosen = this.chosen.filter((id) => this.laps.has(id));
    if (!this.laps.has(this.reference)) this.reference = null;
    const cars = [...new Set(view.laps.map((lap) => `${lap.session}/${lap.car}`))];
    const wanted = ["", ...cars];
    if ([...this.filter.options].map((o) => o.value).join() !== wanted.join()) {
      const value = this.filter.value;
      this.filter.replaceChildren(...wanted.map((car) => new Option(car ? this.carName(car) : "all cars", car)));
      this.filter.value = wanted.includes(value) ? value : "";
    }
    if (!this.own) this.choose();
    if (first) this.drawChannels();
    this.draw();
  }

  /// Session and car, the session only where there are several.
  carName(key) {
    const cut = key.lastIndexOf("/");
    const sessions = new Set(this.view.laps.map((lap) => lap.session));
    return sessions.size > 1 ? `${key.slice(0, cut)}: ${key.slice(cut + 1)}` : key.slice(cut + 1);
  }
  /// Car and lap; and the run, where the car has begun to count anew.
  lapName(lap) { return `${this.carName(`${lap.session}/${lap.car}`)} lap ${lap.lap}${this.runs.get(lap.id) ?? ""}`; }

  counting() { return this.view.laps.filter((lap) => lap.kind === "flying" && lap.time_s !== null); }

  /// Chooses the best lap of each car; the best of all is the reference.
  choose() {
    const best = new Map();
    for (const lap of this.counting()) {
      const key = `${lap.session}/${lap.car}`;
      if (!best.has(key) || lap.time_s < best.get(key).time_s) best.set(key, lap);
    }
    const laps = [...best.values()].sort((a, b) => a.time_s - b.time_s);
    const track = laps[0]?.track;
    this.chosen = laps.filter((lap) => lap.track === track).slice(0, 4).map((lap) => lap.id);
    this.reference = this.chosen[0] ?? null;
  }

  toggle(id) {
    this.own = true;
    if (this.chosen.includes(id)) {
      this.chosen = this.chosen.filter((other) => other !== id);
    } else {
      const track = this.laps.get(id).track;
      this.chosen = [...this.chosen.filter((other) => this.laps.get(other).track === track), id].slice(-MOST_LAPS);
    }
    this.draw();
  }

  refer(id) {
    this.own = true;
    if (!this.chosen.includes(id)) this.toggle(id);
    this.reference = id;
    this.draw();
  }

  trackOf() {
    const key = this.laps.get(this.chosen[0])?.track ?? this.track;
    const track = this.view?.tracks.find((t) => t.key === key) ?? this.view?.tracks[0] ?? null;
    if (track && track.key !== this.track) {
      this.track = track.key;
      [this.range, this.a, this.b, this.borders] = [null, null, null, null];
    }
    return track;
  }

  bordersOf(track) { return this.borders ?? track.sectors; }
  referenceOf() { return this.chosen.includes(this.reference) ? this.reference : this.chosen[0]; }
  colour(id) { return COLOURS[this.chosen.indexOf(id) % COLOURS.length]; }

  /// The data of a lap, or null while it is being loaded.
  numbers(id) {
    // A program that was started again counts its laps anew.
    const key = `${id}@${this.laps.get(id)?.begun}`;
    if (this.data.has(key)) return this.data.get(key);
    if (!this.loading.has(key)) {
      this.loading.add(key);
      Promise.resolve(this.load(id)).then((data) => {
        if (data) {
          this.data.set(key, unpack(data, this.view.channels));
          // What is not shown may go.
          if (this.data.size > 1500) this.data.delete(this.data.keys().next().value);
        }
        this.loading.delete(key);
        if (data) this.drawSoon();
      });
    }
    return null;
  }

  timeAt(numbers, track, s) {
    const at = Math.min(Math.max(s / track.length * track.cells, 0), track.cells);
    const cell = Math.min(Math.floor(at), track.cells - 1), share = at - cell;
    return share === 0 ? numbers.edges[cell] : numbers.edges[cell] + share * (numbers.edges[cell + 1] - numbers.edges[cell]);
  }

  /// A channel at a place, or how far a lap is behind the reference there [s].
  valueAt(id, name, track, s) {
    const numbers = this.numbers(id);
    if (!numbers) return NaN;
    if (name === "delta") {
      const reference = this.numbers(this.referenceOf());
      return reference ? this.timeAt(numbers, track, s) - this.timeAt(reference, track, s) : NaN;
    }
    const values = numbers.values[name];
    return values ? values[Math.min(Math.floor(s / track.length * track.cells), track.cells - 1)] : NaN;
  }

  /// Time of each sector of a lap by these borders [s].
  sectorTimes(id, track, borders) {
    const numbers = this.numbers(id);
    const ends = [0, ...borders, track.length];
    return ends.slice(1).map((to, i) => (numbers ? this.timeAt(numbers, track, to) - this.timeAt(numbers, track, ends[i]) : NaN));
  }

  span() { return this.range ?? [0, this.trackOf()?.length ?? 1]; }
  zoomTo(range) {
    const track = this.trackOf();
    if (!track) return;
    if (range) {
      const [from, to] = [Math.max(0, range[0]), Math.min(track.length, range[1])];
      range = to - from < 1 ? this.range : to - from >= track.length * 0.999 ? null : [from, to];
    }
    this.range = range;
    this.drawSoon();
  }
  sAt(x, width) {
    const [from, to] = this.span();
    return Math.min(Math.max(from + (x - LEFT) / (width - LEFT - 4) * (to - from), from), to);
  }

  drawSoon() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(true); });
  }

  draw(light = false) {
    if (!this.view || !this.root.clientWidth) return;
    for (const made of this.modeButtons) made.setAttribute("aria-pressed", String(made.dataset.mode === this.mode));
    const laps = this.mode === "laps";
    this.channelBar.hidden = this.plots.hidden = this.tableBox.hidden = !laps;
    this.heatBox.hidden = laps;
    if (!light) {
      this.drawList();
      this.drawFindings();
    }
    const track = this.trackOf();
    const none = !track ? "No track with a raceline yet." : !this.view.laps.length ? "No lap has been driven yet." : "";
    const text = none || (this.chosen.length ? "move: cursor · click: hold it · Shift+click: second cursor · drag or wheel: zoom" : "choose laps in the list");
    if (this.hint.textContent !== text) this.hint.textContent = text;
    if (!track) return;
    if (laps) {
      this.drawPlots(track);
      this.drawReadout(track);
    } else {
      this.drawHeat(track);
    }
    this.drawSectors(track);
    this.drawMap();
  }

  drawList() {
    const laps = this.view.laps.filter((lap) => !this.filter.value || `${lap.session}/${lap.car}` === this.filter.value);
    const best = Math.min(...this.counting().map((lap) => lap.time_s));
    const rows = [...laps].sort((a, b) => b.begun - a.begun).slice(0, 1500).map((lap) => {
      const row = make("tr", lap.kind);
      row.dataset.id = lap.id;
      const on = this.chosen.includes(lap.id);
      const box = make("input");
      box.type = "checkbox";
      box.checked = on;
      box.setAttribute("aria-label", this.lapName(lap));
      box.addEventListener("change", () => this.toggle(lap.id));
      const chip = make("span", "an-chip");
      if (on) chip.style.background = this.colour(lap.id);
      const first = make("td");
      first.append(box, chip);
      const time = lap.time_s === null ? lap.kind : digits(lap.time_s, 3);
      const gap = lap.time_s === null || !Number.isFinite(best) ? "" : signed(lap.time_s - best, 3);
      const refer = button("ref", "use this lap as the reference", () => this.refer(lap.id));
      refer.setAttribute("aria-pressed", String(on && this.referenceOf() === lap.id));
      const last = make("td");
      last.append(refer);
      const note = lap.reason ?? (lap.kind === "flying" ? "" : `${lap.kind} lap`);
      row.append(first, make("td", "", this.lapName(lap)), make("td", `number${lap.time_s === best && lap.kind === "flying" ? " best" : ""}`, time), make("td", "number", gap), make("td", "", lap.set ?? ""), last);
      row.title = [this.lapName(lap), clock(lap.begun), note].filter(Boolean).join(", ");
      if (note) row.children[1].append(make("small", "", ` ${note}`));
      return row;
    });
    this.list.replaceChildren(...rows);
  }

  drawChannels() {
    const names = [["delta", "time delta"], ...this.view.channels.map((c) => [c.name, c.label])];
    this.channelBar.replaceChildren(...names.map(([name, label]) => {
      const made = button(label, `show ${label}`, () => {
        if (!this.shown.delete(name)) this.shown.add(name);
        made.setAttribute("aria-pressed", String(this.shown.has(name)));
        this.draw(true);
      });
      made.setAttribute("aria-pressed", String(this.shown.has(name)));
      return made;
    }), button("PNG", "save the plots as a picture", () => this.savePlots()), button("CSV", "save the data of the plots", () => this.savePlotData()));
  }

  channelsShown() {
    const delta = { name: "delta", label: "time delta to the reference", unit: "s", factor: 1, digits: 3, limits: [] };
    return [delta, ...this.view.channels].filter((channel) => this.shown.has(channel.name));
  }

  drawPlots(track) {
    const shown = this.channelsShown();
    const wanted = shown.map((channel) => channel.name).join();
    if (this.plots.dataset.shown !== wanted) {
      this.plots.dataset.shown = wanted;
      this.canvases = new Map(shown.map((channel) => [channel.name, make("canvas")]));
      this.plots.replaceChildren(...this.canvases.values());
    }
    shown.forEach((channel, i) => this.drawPlot(this.canvases.get(channel.name), channel, track, i === 0, i === shown.length - 1));
  }

  drawPlot(canvas, channel, track, first, last) {
    const [context, width, height] = fit(canvas, (channel.name === "delta" ? 130 : 104) + (last ? 18 : 0));
    const bottom = height - BELOW - (last ? 18 : 0), top = TITLE + 4;
    const [from, to] = this.span();
    const x = (s) => LEFT + (s - from) / (to - from) * (width - LEFT - 4);
    const step = track.length / track.cells;
    const cells = [Math.max(0, Math.floor(from / step)), Math.min(track.cells, Math.ceil(to / step))];
    // Deltas are known at the edges of cells, channels at their middles.
    const shift = channel.name === "delta" ? 0 : 0.5;
    const lines = this.chosen.map((id) => {
      const points = [];
      for (let cell = cells[0]; cell <= cells[1] - (shift ? 1 : 0); cell++) {
        points.push([(cell + shift) * step, this.valueAt(id, channel.name, track, (cell + shift) * step) * channel.factor]);
      }
      return [id, points];
    });
    let [low, high] = [Infinity, -Infinity];
    for (const [, points] of lines) for (const [, v] of points) if (v === v) { low = Math.min(low, v); high = Math.max(high, v); }
    if (low > high) [low, high] = [0, 1];
    const pad = Math.max((high - low) * 0.08, 3 * 10 ** -channel.digits);
    [low, high] = [low - pad, high + pad];
    const y = (v) => bottom - (v - low) / (high - low) * (bottom - top);

    this.drawBands(context, track, x, top, bottom, first);
    context.font = "12px system-ui, sans-serif";
    context.lineWidth = 1;
    const [marks, count] = ticks(low, high);
    context.textAlign = "right";
    for (const v of marks) {
      context.strokeStyle = theme("edge");
      context.beginPath();
      context.moveTo(LEFT, y(v));
      context.lineTo(width - 4, y(v));
      context.stroke();
      context.fillStyle = theme("quiet");
      context.fillText(v.toFixed(count), LEFT - 5, y(v) + 4);
    }
    context.setLineDash([5, 4]);
    context.strokeStyle = theme("bad");
    for (const limit of channel.limits.flatMap((l) => (channel.worse === "far" ? [l, -l] : [l]))) {
      const v = limit * channel.factor;
      if (v <= low || v >= high) continue;
      context.beginPath();
      context.moveTo(LEFT, y(v));
      context.lineTo(width - 4, y(v));
      context.stroke();
    }
    context.setLineDash([]);
    context.save();
    context.beginPath();
    context.rect(LEFT, top - 1, width - LEFT - 4, bottom - top + 2);
    context.clip();
    for (const [id, points] of lines) {
      context.strokeStyle = this.colour(id);
      context.lineWidth = id === this.referenceOf() ? 2.4 : 1.5;
      context.beginPath();
      let pen = false;
      for (const [s, v] of points) {
        if (v !== v) { pen = false; continue; }
        if (pen) context.lineTo(x(s), y(v)); else context.moveTo(x(s), y(v));
        pen = true;
      }
      context.stroke();
    }
    context.restore();
    // The title has a strip of its own above the curves.
    context.textAlign = "left";
    context.fillStyle = theme("text");
    context.font = "600 12px system-ui, sans-serif";
    context.fillText(`${channel.label} [${channel.unit}]`, LEFT, 13);
    this.drawCursors(context, x, top, bottom, from, to);
    if (last) {
      context.font = "12px system-ui, sans-serif";
      context.fillStyle = theme("quiet");
      context.textAlign = "center";
      const [places, places_digits] = ticks(from, to);
      for (const s of places) context.fillText(`${s.toFixed(places_digits)}${s === places.at(-1) ? " m" : ""}`, Math.min(x(s), width - 20), height - 4);
    }
  }

  /// Every other sector darker, with its name in the first plot.
  drawBands(context, track, x, top, bottom, named) {
    const ends = [0, ...this.bordersOf(track), track.length];
    context.font = "11px system-ui, sans-serif";
    for (let i = 0; i + 1 < ends.length; i++) {
      const [left, right] = [Math.max(x(ends[i]), LEFT), x(ends[i + 1])];
      if (right <= LEFT) continue;
      context.globalAlpha = i % 2 ? 0.55 : 0.25;
      context.fillStyle = theme("free");
      context.fillRect(left, top, Math.max(0, Math.min(right, context.canvas.clientWidth - 4) - left), bottom - top);
      context.globalAlpha = 1;
      context.fillStyle = theme("quiet");
      context.textAlign = "right";
      if (named && right - left > 20) context.fillText(`S${i + 1}`, Math.min(right, context.canvas.clientWidth - 4) - 3, top + 11);
    }
  }

  drawCursors(context, x, top, bottom, from, to) {
    if (this.selecting) {
      context.globalAlpha = 0.25;
      context.fillStyle = theme("busy");
      context.fillRect(x(Math.min(...this.selecting)), top, Math.abs(x(this.selecting[1]) - x(this.selecting[0])), bottom - top);
      context.globalAlpha = 1;
    }
    for (const [s, dash] of [[this.a, []], [this.b, [4, 3]]]) {
      if (s === null || s < from || s > to) continue;
      context.strokeStyle = theme("text");
      context.setLineDash(dash);
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(x(s), top);
      context.lineTo(x(s), bottom);
      context.stroke();
      context.setLineDash([]);
    }
  }

  /// The values at the cursors, and their differences.
  drawReadout(track) {
    const shown = this.channelsShown();
    const { a, b } = this;
    if (a === null || !this.chosen.length) { this.readout.replaceChildren(); return; }
    const head = make("tr");
    const place = b === null ? `at ${digits(a, 2)} m` : `${digits(a, 2)} → ${digits(b, 2)} m`;
    head.append(make("th", "", place), make("th", "number", b === null ? "time [s]" : "time [s]"), ...shown.map((c) => make("th", "number", `${c.name === "delta" ? "delta" : c.label} [${c.unit}]`)));
    const rows = this.chosen.map((id) => {
      const row = make("tr");
      const chip = make("span", "an-chip");
      chip.style.background = this.colour(id);
      const name = make("td");
      name.append(chip, ` ${this.lapName(this.laps.get(id))}`);
      const numbers = this.numbers(id);
      const time = (s) => (numbers ? this.timeAt(numbers, track, s) : NaN);
      row.append(name, make("td", "number", b === null ? digits(time(a), 3) : signed(time(b) - time(a), 3)));
      for (const c of shown) {
        const [u, v] = [a, b ?? a].map((s) => this.valueAt(id, c.name, track, s) * c.factor);
        row.append(make("td", "number", b === null ? digits(u, c.digits) : `${digits(u, c.digits)} → ${digits(v, c.digits)} (${signed(v - u, c.digits)})`));
      }
      return row;
    });
    this.readout.replaceChildren(head, ...rows);
  }

  /// Times of sectors, the best of each, and the ideal lap.
  drawSectors(track) {
    const borders = this.bordersOf(track);
    const own = this.borders !== null;
    const of = (lap) => (own ? this.sectorTimes(lap.id, track, borders) : lap.sectors.map((v) => v ?? NaN));
    let ideal = track.ideal;
    if (own) {
      const all = this.counting().filter((lap) => lap.track === track.key && this.numbers(lap.id)).map(of).filter((times) => times.every((t) => t === t));
      ideal = all.length ? all[0].map((_, i) => Math.min(...all.map((times) => times[i]))) : null;
    }
    const key = JSON.stringify([track.key, borders, ideal, this.chosen, this.chosen.map((id) => Boolean(this.numbers(id))), own, this.data.size]);
    if (this.sectors.dataset.key === key) return;
    this.sectors.dataset.key = key;
    const row = (tag, cells) => {
      const made = make("tr");
      cells.forEach(([text, className]) => made.append(make(tag, className, text)));
      return made;
    };
    const names = [...borders, 0].map((_, i) => [`S${i + 1}`, "number"]);
    const rows = this.chosen.map((id) => this.laps.get(id)).map((lap) => {
      const made = row("td", [["", ""], ...of(lap).map((t, i) => [digits(t, 3), `number${ideal && Math.abs(t - ideal[i]) < 5e-4 ? " best" : ""}`]), [digits(lap.time_s ?? NaN, 3), "number"]]);
      const chip = make("span", "an-chip");
      chip.style.background = this.colour(lap.id);
      made.firstChild.append(chip, ` ${this.lapName(lap)}`);
      return made;
    });
    if (ideal) rows.push(row("td", [["ideal lap", "ideal"], ...ideal.map((t) => [digits(t, 3), "number ideal"]), [digits(ideal.reduce((a, c) => a + c, 0), 3), "number ideal"]]));
    this.sectors.replaceChildren(row("th", [["sectors [s]", ""], ...names, ["lap", "number"]]), ...rows);
  }

  async editSectors() {
    const track = this.trackOf();
    if (!track) return;
    this.editing = !this.editing;
    this.edit.setAttribute("aria-pressed", String(this.editing));
    this.edit.textContent = this.editing ? "keep sectors" : "edit sectors";
    if (this.editing) {
      this.borders ??= [...track.sectors];
    } else if (this.keep && this.borders) {
      const wrong = await this.keep(track.key, this.borders);
      if (wrong) this.say(wrong);
      else this.borders = null;
    }
    this.drawSoon();
  }

  /// Shows a message in place of the hint, for a while.
  say(text) {
    this.edit.title = text;
    this.mapBar.querySelector(".an-said")?.remove();
    const said = make("span", "an-said", text);
    said.setAttribute("role", "alert");
    this.mapBar.append(said);
    setTimeout(() => said.remove(), 8000);
  }

  // The track map.

  mapView(track) {
    const { clientWidth: width, clientHeight: height } = this.map;
    const xs = track.line.map((p) => p[0]), ys = track.line.map((p) => p[1]);
    let box = [Math.min(...xs) - 2, Math.min(...ys) - 2, Math.max(...xs) + 2, Math.max(...ys) + 2];
    if (this.finding?.seen.length) {
      const fx = this.finding.seen.map((p) => p[0]), fy = this.finding.seen.map((p) => p[1]);
      box = [Math.min(...fx) - 1.5, Math.min(...fy) - 1.5, Math.max(...fx) + 1.5, Math.max(...fy) + 1.5];
    }
    const scale = Math.min(width / (box[2] - box[0]), height / (box[3] - box[1]));
    const [cx, cy] = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    return { scale, to: ([px, py]) => [width / 2 + (px - cx) * scale, height / 2 - (py - cy) * scale], origin: [width / 2 - cx * scale, height / 2 + cy * scale] };
  }

  pointAt(track, s) {
    const at = Math.min(Math.max(s / track.length * track.cells, 0), track.cells - 1e-9);
    const i = Math.floor(at), share = at - i;
    const [a, b] = [track.line[i], track.line[i + 1]];
    return [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])];
  }

  drawMap() {
    const track = this.trackOf();
    if (!track || !this.map.clientWidth) return;
    const [context] = fit(this.map);
    const view = this.mapView(track);
    this.findingBack.hidden = !this.finding;
    if (this.walls?.key !== track.key) this.walls = { key: track.key, path: new Path2D(track.walls) };
    const ratio = window.devicePixelRatio || 1;
    context.save();
    context.setTransform(ratio * view.scale, 0, 0, ratio * view.scale, ratio * view.origin[0], ratio * view.origin[1]);
    context.strokeStyle = theme("wall");
    context.lineWidth = track.width;
    context.stroke(this.walls.path);
    context.restore();
    this.drawLine(context, track, view);
    context.fillStyle = theme("bad");
    for (const finding of this.view.findings.filter((f) => f.track === track.key)) {
      context.globalAlpha = !this.finding || this.finding === finding ? 1 : 0.4;
      const size = this.finding ? 2.5 : 1.5;
      for (const point of finding.seen) {
        const [px, py] = view.to(point);
        context.fillRect(px - size, py - size, 2 * size, 2 * size);
      }
    }
    context.globalAlpha = 1;
    context.font = "600 12px system-ui, sans-serif";
    context.fillStyle = theme("text");
    context.strokeStyle = theme("text");
    context.lineWidth = 2;
    for (const [s, name] of [[0, "start"], ...this.bordersOf(track).map((border) => [border, ""])]) {
      const [p, q] = [this.pointAt(track, s), this.pointAt(track, (s + 0.2) % track.length)];
      const length = Math.hypot(q[0] - p[0], q[1] - p[1]) || 1;
      const n = [-(q[1] - p[1]) / length * 0.7, (q[0] - p[0]) / length * 0.7];
      const [a, b] = [view.to([p[0] + n[0], p[1] + n[1]]), view.to([p[0] - n[0], p[1] - n[1]])];
      context.beginPath();
      context.moveTo(...a);
      context.lineTo(...b);
      context.stroke();
      if (name) context.fillText(name, a[0] + 4, a[1] - 3);
    }
    for (const [s, hollow] of [[this.a, false], [this.b, true]]) {
      if (s === null) continue;
      const [px, py] = view.to(this.pointAt(track, s));
      context.beginPath();
      context.arc(px, py, 6, 0, 2 * Math.PI);
      context.lineWidth = 2.5;
      context.strokeStyle = theme("busy");
      context.fillStyle = hollow ? theme("ground") : theme("busy");
      context.fill();
      context.stroke();
    }
  }

  /// The raceline: red where the first lap that is not the reference loses time, green where it gains.
  drawLine(context, track, view) {
    const reference = this.numbersOrNull(this.referenceOf());
    const other = this.numbersOrNull(this.chosen.find((id) => id !== this.referenceOf()));
    const step = 4;
    context.lineWidth = 3;
    for (let cell = 0; cell < track.cells; cell += step) {
      const to = Math.min(cell + step, track.cells);
      let colour = theme("line");
      if (reference && other) {
        const lost = other.edges[to] - other.edges[cell] - (reference.edges[to] - reference.edges[cell]);
        const share = lost / (reference.edges[to] - reference.edges[cell]);
        colour = share > 0.03 ? theme("bad") : share < -0.03 ? theme("good") : colour;
      }
      context.strokeStyle = colour;
      context.beginPath();
      for (let i = cell; i <= to; i++) {
        const p = view.to(track.line[i]);
        if (i === cell) context.moveTo(...p); else context.lineTo(...p);
      }
      context.stroke();
    }
  }
  numbersOrNull(id) { return id ? this.numbers(id) : null; }

  /// Arc length of the point of the line nearest to the pointer; null away from it.
  nearest(e) {
    const track = this.trackOf();
    if (!track) return null;
    const view = this.mapView(track);
    let [best, cell] = [Infinity, 0];
    track.line.forEach((p, i) => {
      const [px, py] = view.to(p);
      const distance = Math.hypot(px - e.offsetX, py - e.offsetY);
      if (distance < best) [best, cell] = [distance, i];
    });
    return best < 30 ? Math.min(cell, track.cells) * track.length / track.cells : null;
  }

  mapClicked(e) {
    const track = this.trackOf();
    const s = this.nearest(e);
    if (s === null) return;
    if (this.editing) {
      const near = this.borders.findIndex((border) => Math.abs(border - s) < Math.max(0.6, track.length * 0.012));
      if (near >= 0) this.borders.splice(near, 1);
      else if (s > 0.5 && s < track.length - 0.5) this.borders.push(s);
      this.borders.sort((a, b) => a - b);
    } else if (e.shiftKey) {
      this.b = s;
    } else {
      this.a = s;
      this.pinned = true;
    }
    this.drawSoon();
  }

  // Health over the track.

  drawHeat(track) {
    if (!this.heatBar.childElementCount) {
      this.heatMetric = make("select");
      this.heatMetric.setAttribute("aria-label", "Metric");
      this.heatMetric.replaceChildren(...this.view.channels.map((c) => new Option(`${c.label} [${c.unit}]`, c.name)));
      this.heatMetric.value = this.metric;
      this.heatMetric.addEventListener("change", () => { this.metric = this.heatMetric.value; this.draw(true); });
      this.legend = make("canvas", "an-legend");
      this.heatBar.append(this.heatMetric, this.legend, make("span", "an-hint", "laps of the list, the newest at the top; a line marks causes"), button("PNG", "save the picture", () => save("health.png", this.heat.toDataURL("image/png"))), button("CSV", "save the data", () => this.saveHeatData()));
    }
    const channel = this.view.channels.find((c) => c.name === this.metric);
    const rows = this.view.laps.filter((lap) => lap.track === track.key && (!this.filter.value || `${lap.session}/${lap.car}` === this.filter.value))
      .sort((a, b) => b.begun - a.begun).slice(0, 1500);
    const tall = Math.min(Math.max(rows.length * 12, 160), Math.max(560, window.innerHeight - 300));
    const [context, width] = fit(this.heat, tall + 18);
    this.heatRows = rows;
    const high = tall / Math.max(rows.length, 1);
    const bad = (v) => (channel.worse === "far" ? Math.abs(v) : v);
    const all = [];
    const numbers = rows.map((lap) => this.numbers(lap.id));
    for (const n of numbers) if (n?.values[this.metric]) for (let i = 0; i < track.cells; i += 3) if (n.values[this.metric][i] === n.values[this.metric][i]) all.push(bad(n.values[this.metric][i]));
    all.sort((a, b) => a - b);
    const quantile = (q) => all[Math.floor(q * (all.length - 1))] ?? 0;
    // From good to bad: up to the limit of a warning where there is one, else from the lowest to the highest values.
    let ends = channel.worse === "low" ? [quantile(0.98), quantile(0.01)] : [quantile(0.02), quantile(0.99)];
    if (channel.limits.length && channel.worse === "low") ends = [1, channel.limits[0]];
    else if (channel.limits.length) ends = [0, channel.limits[0]];
    if (ends[0] === ends[1]) ends[1] += channel.worse === "low" ? -1e-6 : 1e-6;
    const colour = (v) => {
      const at = Math.min(Math.max((bad(v) - ends[0]) / (ends[1] - ends[0]), 0), 1) * (HEAT.length - 1);
      const i = Math.min(Math.floor(at), HEAT.length - 2), share = at - i;
      return `rgb(${HEAT[i].map((c, k) => Math.round(c + share * (HEAT[i + 1][k] - c))).join()})`;
    };
    const [from, to] = this.span();
    const x = (s) => LEFT + (s - from) / (to - from) * (width - LEFT - 4);
    const step = track.length / track.cells;
    context.font = "11px system-ui, sans-serif";
    rows.forEach((lap, row) => {
      const y = row * high;
      const n = numbers[row];
      if (this.chosen.includes(lap.id)) {
        context.fillStyle = this.colour(lap.id);
        context.fillRect(LEFT - 5, y, 4, high - (high > 3 ? 1 : 0));
      }
      if (high >= 11 || row % Math.ceil(12 / high) === 0) {
        context.fillStyle = theme("quiet");
        context.textAlign = "right";
        context.fillText(`${lap.car.replace(/^car-/, "")}·${lap.lap}`, LEFT - 8, y + Math.min(high / 2 + 4, 11));
      }
      const values = n?.values[this.metric];
      if (!values) return;
      for (let cell = Math.max(0, Math.floor(from / step)); cell < Math.min(track.cells, Math.ceil(to / step)); cell++) {
        if (values[cell] !== values[cell]) continue;
        context.fillStyle = colour(values[cell]);
        const left = Math.max(x(cell * step), LEFT);
        context.fillRect(left, y, x((cell + 1) * step) - left + 0.5, high - (high > 3 ? 1 : 0));
      }
      context.fillStyle = theme("text");
      for (const [c0, c1] of high >= 5 ? n.causes : []) {
        const [l, r] = [x(c0 * step), x((c1 + 1) * step)];
        if (r > LEFT) context.fillRect(Math.max(l, LEFT), y + high / 2 - 0.5, Math.max(r - Math.max(l, LEFT), 2), 1.5);
      }
    });
    context.strokeStyle = theme("text");
    context.globalAlpha = 0.5;
    for (const border of this.bordersOf(track)) {
      context.beginPath();
      context.moveTo(x(border), 0);
      context.lineTo(x(border), tall);
      context.stroke();
    }
    context.globalAlpha = 1;
    if (this.a !== null) this.drawCursors(context, x, 0, tall, from, to);
    context.fillStyle = theme("quiet");
    context.textAlign = "center";
    const [places, count] = ticks(from, to);
    for (const s of places) context.fillText(`${s.toFixed(count)}${s === places.at(-1) ? " m" : ""}`, Math.min(x(s), width - 20), tall + 14);
    this.heatGeometry = { high, step, channel };
    this.drawLegend(colour, ends, channel);
  }

  drawLegend(colour, ends, channel) {
    const [context, width] = fit(this.legend, 22);
    const bar = [44, width - 44];
    for (let px = bar[0]; px < bar[1]; px++) {
      context.fillStyle = colour(ends[0] + (px - bar[0]) / (bar[1] - bar[0]) * (ends[1] - ends[0]));
      context.fillRect(px, 5, 1, 12);
    }
    context.fillStyle = theme("text");
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "right";
    context.fillText(digits(ends[0] * channel.factor, 1), bar[0] - 4, 15);
    context.textAlign = "left";
    context.fillText(digits(ends[1] * channel.factor, 1), bar[1] + 4, 15);
  }

  /// What lies under the pointer: lap and place, in words.
  heatHover(e) {
    const track = this.trackOf();
    if (!track || !this.heatGeometry) return null;
    const { high, step, channel } = this.heatGeometry;
    const lap = this.heatRows[Math.floor(e.offsetY / high)];
    if (!lap || e.offsetX < LEFT) return null;
    const s = this.sAt(e.offsetX, this.heat.clientWidth);
    const cell = Math.min(Math.floor(s / step), track.cells - 1);
    const numbers = this.numbers(lap.id);
    const causes = numbers?.causes.filter(([from, to]) => from <= cell && cell <= to).map(([, , text]) => text) ?? [];
    const state = numbers?.states.find(([from, to]) => from <= cell && cell <= to)?.[2];
    const value = numbers?.values[channel.name]?.[cell];
    this.heatText.textContent = `${this.lapName(lap)} at ${digits(s, 1)} m: ${channel.label} ${digits(value * channel.factor, channel.digits)} ${channel.unit}` +
      `${state ? `, ${state}` : ""}${causes.length ? `: ${causes.join("; ")}` : ""}`;
    this.a = s;
    this.drawSoon();
    return { lap, s };
  }

  drawFindings() {
    const place = (f) => `${digits(f.from_s, 1)} to ${digits(f.to_s, 1)} m, ${f.side}`;
    this.findings.replaceChildren(...this.view.findings.map((finding) => {
      const line = make("li");
      const show = button(place(finding), "show it on the map", () => {
        this.finding = finding;
        this.track = finding.track;
        this.a = finding.from_s;
        this.pinned = true;
        this.draw();
        this.map.scrollIntoView({ block: "nearest" });
      });
      const offset = finding.disagreement === "not_there" ? "" : `, ${digits(finding.offset_m * 100, 0)}${finding.offset_m > 0.99 ? " or more" : ""} cm off`;
      line.append(show, ` ${WRONG[finding.disagreement]}: ${digits(finding.length_m, 1)} m long${offset}; on ${finding.laps} of ${finding.of_laps} laps, ` +
        `${finding.cars} ${finding.cars === 1 ? "car" : "cars"}, since ${clock(finding.since)}`);
      return line;
    }));
    if (!this.view.findings.length) this.findings.append(make("li", "an-none", "nowhere: scans and map agree on every stretch that several laps have seen"));
    // Laps that lost nothing are shown only while they are the newest of their car.
    const newest = new Map(this.view.advice.map((advice) => [advice.car, advice.id]));
    const told = this.view.advice.filter((advice) => advice.channel || newest.get(advice.car) === advice.id);
    this.advice.replaceChildren(...told.slice(-60).reverse().map((advice) => {
      const line = make("li");
      const show = button(`${advice.car} lap ${advice.lap}${this.runs.get(advice.id) ?? ""}`, "show the evidence", () => {
        this.own = true;
        this.mode = "laps";
        if (this.laps.has(advice.reference)) this.reference = advice.reference;
        this.chosen = [...new Set([advice.reference, advice.id])].filter((id) => this.laps.has(id));
        if (advice.channel) this.shown.add(advice.channel);
        this.drawChannels();
        this.zoomTo(advice.to_s - advice.from_s > 0.5 ? [advice.from_s - 1, advice.to_s + 1] : null);
        this.a = advice.from_s;
        this.b = advice.to_s;
        this.pinned = true;
        this.draw();
      });
      line.append(show, ` ${advice.text}`);
      return line;
    }));
    if (!told.length) this.advice.append(make("li", "an-none", "a line for each lap, from a car's second lap on"));
  }

  // Files.

  savePlots() {
    const canvases = [...this.canvases.values()];
    const whole = make("canvas");
    whole.width = Math.max(...canvases.map((c) => c.width));
    whole.height = canvases.reduce((sum, c) => sum + c.height, 0);
    const context = whole.getContext("2d");
    context.fillStyle = theme("ground");
    context.fillRect(0, 0, whole.width, whole.height);
    let y = 0;
    for (const canvas of canvases) {
      context.drawImage(canvas, 0, y);
      y += canvas.height;
    }
    save("laps.png", whole.toDataURL("image/png"));
  }

  plotData() {
    const track = this.trackOf();
    const shown = this.channelsShown();
    const head = ["s [m]", ...this.chosen.flatMap((id) => ["time [s]", ...shown.map((c) => `${c.label} [${c.unit}]`)].map((what) => `${this.lapName(this.laps.get(id))} ${what}`))];
    const rows = [head.map((text) => `"${text.replaceAll('"', "")}"`).join()];
    for (let cell = 0; cell < track.cells; cell++) {
      const s = (cell + 0.5) * track.length / track.cells;
      const cells = this.chosen.flatMap((id) => {
        const numbers = this.numbers(id);
        return [numbers ? this.timeAt(numbers, track, s) : NaN, ...shown.map((c) => this.valueAt(id, c.name, track, s) * c.factor)];
      });
      rows.push([s.toFixed(3), ...cells.map((v) => (Number.isFinite(v) ? v.toFixed(4) : ""))].join());
    }
    return `${rows.join("\n")}\n`;
  }
  savePlotData() { if (this.trackOf()) save("laps.csv", this.plotData(), "text/csv"); }

  saveHeatData() {
    const track = this.trackOf();
    const { channel } = this.heatGeometry;
    const step = track.length / track.cells;
    const rows = [["lap", ...Array.from({ length: track.cells }, (_, i) => ((i + 0.5) * step).toFixed(3))].join()];
    for (const lap of this.heatRows) {
      const values = this.numbers(lap.id)?.values[channel.name];
      if (values) rows.push([`"${this.lapName(lap)}"`, ...Array.from(values, (v) => (v === v ? (v * channel.factor).toFixed(4) : ""))].join());
    }
    save(`${channel.name}.csv`, `${rows.join("\n")}\n`, "text/csv");
  }
}
