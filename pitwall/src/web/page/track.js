// The track: map, raceline, cars with trail and spread, particles and end points of the selected car.

import { STATES, colourOf, fixed } from "/cards.js";

/// Length of a trail [s]: of the selected car, and of the others if there are many.
const TRAIL_S = 12, SHORT_TRAIL_S = 3, MANY = 6;
/// Margin around the raceline, so that the walls are in view [m].
const MARGIN = 2.4;
const END_POINTS = ["good", "quiet", "warn", "bad"];

let colours = null;
/// The theme's colours. Asking the browser for each would take longer than drawing.
export function palette() {
  const theme = document.documentElement.dataset.theme;
  if (colours?.theme !== theme) {
    const style = getComputedStyle(document.documentElement);
    colours = { theme };
    for (const name of ["good", "busy", "warn", "bad", "none", "ground", "text", "quiet", "edge", "wall", "unknown", "free", "line"]) {
      colours[name] = style.getPropertyValue(`--${name}`).trim();
    }
  }
  return colours;
}

/// Width of a bad stretch relative to a good one, for readers who do not see the colours.
const WIDTHS = { good: 1, busy: 1.6, warn: 1.8, bad: 2.8 };

/// The quantities that can be painted along the track: name, colour of a place, legend.
const PAINTS = {
  off: null,
  state: [(p) => (STATES[p.state.toUpperCase()] ?? STATES.INIT)[1], [["good", "localized"], ["warn", "degraded"], ["bad", "lost, stale"], ["busy", "searching"]]],
  alignment: [(p) => (p.alignment > 0.7 ? "good" : p.alignment > 0.45 ? "warn" : "bad"), [["good", "> 70 %"], ["warn", "> 45 %"], ["bad", "less"]]],
  slip: [(p) => (Math.abs(p.slip) <= 0.08 ? "good" : Math.abs(p.slip) <= 0.2 ? "warn" : "bad"), [["good", "≤ 8 %"], ["warn", "≤ 20 %"], ["bad", "more"]]],
};

export class Track {
  /// `placed(x, y, heading)` is called when a pose was dragged, `picked(number)` when a candidate was clicked.
  constructor(canvas, placed, picked) {
    this.canvas = canvas;
    this.placed = placed;
    this.picked = picked;
    this.maps = new Map();
    this.fetching = new Set();
    this.trails = new Map();
    this.view = null;
    this.fitted = false;
    this.follow = false;
    this.placing = false;
    this.drag = null;
    this.candidates = [];
    this.paint = "off";
    this.profiles = new Map();
    this.size = "";
    this.snapshot = null;
    this.selected = null;
    canvas.addEventListener("pointerdown", (e) => this.pressed(e));
    canvas.addEventListener("pointermove", (e) => this.moved(e));
    canvas.addEventListener("pointerup", (e) => this.released(e));
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY);
    }, { passive: false });
  }

  /// Stores a snapshot, and draws it at the browser's next frame.
  update(snapshot, selected) {
    this.snapshot = snapshot;
    this.selected = selected;
    for (const car of snapshot.cars) {
      if (!car.pose || car.blind) continue;
      const trail = this.trails.get(car.car) ?? [];
      const last = trail.at(-1);
      const now = snapshot.now / 1e9;
      if (!last || Math.hypot(last[0] - car.pose.x_m, last[1] - car.pose.y_m) > 0.05) {
        trail.push([car.pose.x_m, car.pose.y_m, car.state, now]);
        while (trail[0][3] < now - TRAIL_S) trail.shift();
        this.trails.set(car.car, trail);
      }
    }
    const { selected: details } = snapshot;
    if (details?.health_profile) this.profiles.set(details.car, details.health_profile);
    for (const car of snapshot.maps) {
      if (!this.maps.has(car) && !this.fetching.has(car)) this.fetchMap(car);
    }
    if (!this.asked) {
      this.asked = true;
      requestAnimationFrame(() => { this.asked = false; this.draw(); });
    }
  }

  /// A new epoch has begun: forgets everything but the maps.
  restart() {
    this.trails.clear();
    this.profiles.clear();
    this.candidates = [];
  }

  /// Paints the next quantity along the track; returns its name and legend.
  paintNext() {
    const names = Object.keys(PAINTS);
    this.paint = names[(names.indexOf(this.paint) + 1) % names.length];
    return [this.paint, PAINTS[this.paint]?.[1] ?? []];
  }

  async fetchMap(car) {
    this.fetching.add(car);
    const response = await fetch(`/map/${car}`);
    this.fetching.delete(car);
    if (response.ok) this.maps.set(car, await response.json());
  }

  /// The map that is shown: that of the selected car, or else the first one.
  map() { return this.maps.get(this.selected) ?? this.maps.values().next().value; }

  /// Draws the grid once for each theme.
  image(map) {
    const themed = palette();
    const { theme } = themed;
    map.images ??= {};
    if (map.images[theme]) return map.images[theme];
    const colour = (name) => themed[name].match(/[0-9a-f]{2}/gi).map((h) => parseInt(h, 16));
    const colours = [colour("free"), colour("wall"), colour("unknown")];
    const image = new OffscreenCanvas(map.width, map.height);
    const context = image.getContext("2d");
    const pixels = context.createImageData(map.width, map.height);
    let at = 0;
    for (const [cell, length] of map.runs) {
      const [r, g, b] = colours[cell];
      for (let i = 0; i < length; i++, at++) {
        // The grid's first row is its lowest one; that of the image is its highest.
        const row = map.height - 1 - Math.floor(at / map.width);
        pixels.data.set([r, g, b, 255], 4 * (row * map.width + at % map.width));
      }
    }
    context.putImageData(pixels, 0, 0);
    map.images[theme] = image;
    return image;
  }

  /// Shows the whole track.
  fit() {
    const map = this.map();
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!map || !width) return;
    let points = map.raceline?.points ?? [];
    if (points.length < 3) {
      const [w, h] = [map.width * map.resolution, map.height * map.resolution];
      const { x, y, heading } = map.origin;
      const [c, s] = [Math.cos(heading), Math.sin(heading)];
      points = [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]);
    }
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    const [left, right, low, high] = [Math.min(...xs) - MARGIN, Math.max(...xs) + MARGIN, Math.min(...ys) - MARGIN, Math.max(...ys) + MARGIN];
    // The tools cover the lowest part.
    const tools = 48;
    const scale = Math.min(width / (right - left), (height - tools) / (high - low));
    this.view = { x: (left + right) / 2, y: (low + high) / 2 - tools / 2 / scale, scale };
    this.fitted = true;
    this.handled = false;
  }

  /// Zooms about a point of the canvas [px].
  zoom(factor, px = this.canvas.clientWidth / 2, py = this.canvas.clientHeight / 2) {
    if (!this.view) return;
    const [x, y] = this.toMap(px, py);
    this.view.scale = Math.min(Math.max(this.view.scale * factor, 1), 2000);
    this.handled = true;
    const [x2, y2] = this.toMap(px, py);
    this.view.x += x - x2;
    this.view.y += y - y2;
  }

  toMap(px, py) {
    const { x, y, scale } = this.view;
    return [x + (px - this.canvas.clientWidth / 2) / scale, y - (py - this.canvas.clientHeight / 2) / scale];
  }

  toCanvas(x, y) {
    const view = this.view;
    return [this.canvas.clientWidth / 2 + (x - view.x) * view.scale, this.canvas.clientHeight / 2 - (y - view.y) * view.scale];
  }

  pressed(e) {
    if (!this.view) return;
    this.canvas.setPointerCapture(e.pointerId);
    const candidate = this.candidates.find(({ pose }) => {
      const [px, py] = this.toCanvas(pose.x, pose.y);
      return Math.hypot(px - e.offsetX, py - e.offsetY) < 14;
    });
    if (candidate && !this.placing) {
      this.picked(candidate.number);
      return;
    }
    this.drag = { from: [e.offsetX, e.offsetY], to: [e.offsetX, e.offsetY], view: { ...this.view } };
  }

  moved(e) {
    if (!this.drag) return;
    this.drag.to = [e.offsetX, e.offsetY];
    if (!this.placing) {
      const { from, to, view } = this.drag;
      this.follow = false;
      this.handled = true;
      this.view.x = view.x - (to[0] - from[0]) / view.scale;
      this.view.y = view.y + (to[1] - from[1]) / view.scale;
    }
  }

  released() {
    const drag = this.drag;
    this.drag = null;
    if (!drag || !this.placing) return;
    const [x, y] = this.toMap(...drag.from);
    const [dx, dy] = [drag.to[0] - drag.from[0], drag.from[1] - drag.to[1]];
    // A click has a position but no heading: a drag of a few pixels is needed.
    if (Math.hypot(dx, dy) > 8) this.placed(x, y, Math.atan2(dy, dx));
  }

  draw() {
    const canvas = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !this.snapshot) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const colour = palette();
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colour.unknown;
    context.fillRect(0, 0, width, height);
    const map = this.map();
    // The whole track stays in view until somebody zooms or pans, also when the window changes its size.
    if (this.size !== `${width} ${height}`) {
      this.size = `${width} ${height}`;
      if (!this.handled) this.fitted = false;
    }
    if (!this.fitted) this.fit();
    if (!this.view && this.snapshot.cars[0]?.pose) {
      this.view = { x: this.snapshot.cars[0].pose.x_m, y: this.snapshot.cars[0].pose.y_m, scale: 30 };
    }
    if (!this.view) return;
    const followed = this.snapshot.cars.find((car) => car.car === this.selected)?.pose;
    if (this.follow && followed) this.handled = true;
    if (this.follow && followed) Object.assign(this.view, { x: followed.x_m, y: followed.y_m });

    // Coordinates from here on are those of `map` [m], with y up.
    const { scale } = this.view;
    const [ox, oy] = this.toCanvas(0, 0);
    context.setTransform(ratio * scale, 0, 0, -ratio * scale, ratio * ox, ratio * oy);
    const pixel = 1 / scale;
    if (map) this.drawMap(context, map, pixel, colour);
    if (map && PAINTS[this.paint]) this.drawStrip(context, map, pixel, colour);
    this.snapshot.cars.forEach((car, i) => this.drawTrail(context, car, pixel, colour));
    const selected = this.snapshot.selected;
    if (selected && selected.car === this.selected) this.drawSelected(context, selected, pixel, colour);
    this.snapshot.cars.forEach((car, i) => this.drawCar(context, car, i, pixel, colour));
    // The best is drawn last, so that it is on top.
    for (const candidate of [...this.candidates].reverse()) this.drawCandidate(context, candidate, pixel, colour);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.drawNames(context, colour);
    if (this.drag && this.placing) this.drawPlacing(context, colour);
  }

  drawMap(context, map, pixel, colour) {
    context.save();
    context.translate(map.origin.x, map.origin.y);
    context.rotate(map.origin.heading);
    context.scale(map.resolution, -map.resolution);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.image(map), 0, -map.height);
    context.restore();
    const points = map.raceline?.points ?? [];
    if (points.length > 2) {
      context.beginPath();
      points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.closePath();
      context.setLineDash([8 * pixel, 6 * pixel]);
      context.strokeStyle = colour.line;
      context.lineWidth = 1.5 * pixel;
      context.stroke();
      context.setLineDash([]);
    }
  }

  /// The latest values of the selected car at each place of the lap.
  drawStrip(context, map, pixel, colour) {
    const profile = this.profiles.get(this.selected);
    const line = map.raceline?.points ?? [];
    if (!profile?.length || line.length < 3) return;
    const [colourOfPlace] = PAINTS[this.paint];
    const width = Math.max(0.2, 5 * pixel);
    context.globalAlpha = 0.7;
    profile.forEach((place, i) => {
      if (!place) return;
      const [from, to] = [i, i + 1].map((k) => Math.round(k / profile.length * line.length));
      const name = colourOfPlace(place);
      context.strokeStyle = colour[name];
      context.lineWidth = width * (WIDTHS[name] ?? 1);
      context.beginPath();
      for (let k = from; k <= to; k++) {
        const [x, y] = line[k % line.length];
        if (k === from) context.moveTo(x, y); else context.lineTo(x, y);
      }
      context.stroke();
    });
    context.globalAlpha = 1;
  }

  /// The car's trail, in the colours of its state at the time. Older parts are fainter, in a few steps.
  drawTrail(context, car, pixel, colour) {
    const trail = this.trails.get(car.car) ?? [];
    const now = this.snapshot.now / 1e9;
    const whole = car.car === this.selected || this.snapshot.cars.length <= MANY;
    const begin = whole ? 0 : trail.findIndex(([, , , at]) => at >= now - SHORT_TRAIL_S);
    if (begin < 0) return;
    context.lineWidth = 3 * pixel;
    let style = "";
    for (let i = begin + 1; i < trail.length; i++) {
      const [x0, y0] = trail[i - 1], [x1, y1, state, at] = trail[i];
      const jump = Math.hypot(x1 - x0, y1 - y0) > 2;
      const fresh = Math.ceil(6 * (1 - (now - at) / (whole ? TRAIL_S : SHORT_TRAIL_S)));
      const next = `${state} ${fresh}`;
      if (next !== style || jump) {
        if (style) context.stroke();
        style = next;
        context.globalAlpha = Math.min(Math.max(0.8 * fresh / 6, 0), 1);
        context.strokeStyle = colour[(STATES[state] ?? STATES.INIT)[1]];
        context.beginPath();
        context.moveTo(jump ? x1 : x0, jump ? y1 : y0);
      }
      if (!jump) context.lineTo(x1, y1);
    }
    if (style) context.stroke();
    context.globalAlpha = 1;
  }

  drawSelected(context, { particles, end_points: endPoints }, pixel, colour) {
    context.fillStyle = colour.busy;
    const size = 1.5 * pixel;
    for (const [x, y, , weight] of particles) {
      context.globalAlpha = 0.15 + 0.6 * weight;
      context.fillRect(x - size, y - size, 2 * size, 2 * size);
    }
    context.globalAlpha = 1;
    const point = 2 * pixel;
    for (const [x, y, kind] of endPoints) {
      context.fillStyle = colour[END_POINTS[kind] ?? "quiet"];
      context.fillRect(x - point, y - point, 2 * point, 2 * point);
    }
  }

  drawCar(context, car, index, pixel, colour) {
    if (!car.pose) return;
    const { x_m: x, y_m: y, heading_rad: heading, covariance: c } = car.pose;
    context.globalAlpha = car.blind ? 0.35 : 1;
    // Two sigma, along the axes of the covariance.
    const mean = (c.xx + c.yy) / 2, half = Math.hypot((c.xx - c.yy) / 2, c.xy);
    const [major, minor] = [Math.sqrt(Math.max(mean + half, 0)), Math.sqrt(Math.max(mean - half, 0))];
    context.strokeStyle = colourOf(index);
    context.lineWidth = 1.5 * pixel;
    context.beginPath();
    context.ellipse(x, y, 2 * major, 2 * minor, Math.atan2(2 * c.xy, c.xx - c.yy) / 2, 0, 2 * Math.PI);
    context.stroke();
    context.save();
    context.translate(x, y);
    context.rotate(heading);
    // As large as the car, but large enough to be visible. base_link is the rear axle.
    const size = Math.max(1, 18 * pixel / 0.5);
    context.scale(size, size);
    context.beginPath();
    context.moveTo(0.42, 0);
    context.lineTo(-0.1, 0.16);
    context.lineTo(-0.02, 0);
    context.lineTo(-0.1, -0.16);
    context.closePath();
    context.fillStyle = car.blind ? colour.none : colourOf(index);
    context.fill();
    context.lineWidth = 2 * pixel / size;
    context.strokeStyle = colour[(STATES[car.state] ?? STATES.INIT)[1]];
    context.stroke();
    context.restore();
    context.globalAlpha = 1;
  }

  /// Names beside the cars.
  drawNames(context, colour) {
    const placed = [];
    context.lineWidth = 4;
    context.strokeStyle = colour.ground;
    // The selected car and those in trouble first, so that their names have room.
    const order = this.snapshot.cars.map((car, index) => [car, index]);
    const rank = (car) => (car.car === this.selected ? 0 : car.state === "LOCALIZED" ? 2 : 1);
    order.sort(([a], [b]) => rank(a) - rank(b));
    order.forEach(([car, index]) => {
      if (!car.pose) return;
      const [px, py] = this.toCanvas(car.pose.x_m, car.pose.y_m);
      const chosen = car.car === this.selected;
      context.font = `${chosen ? "700 14px" : "13px"} system-ui, sans-serif`;
      const silent = car.blind ? ` ${fixed(car.quiet_s, 0)} s` : "";
      const label = `${(STATES[car.state] ?? ["?"])[0]} ${car.car}${silent}`;
      const width = context.measureText(label).width;
      // To the left of a car at the right edge.
      const x = px + 14 + width > this.canvas.clientWidth ? px - 14 - width : px + 14;
      // Beside the car, or a little higher or lower. Where there is no room, the name is left out: it is on the card.
      const free = (at) => !placed.some((other) => Math.abs(other.y - at) < 15 && x < other.x + other.width + 4 && other.x < x + width + 4);
      const y = [py - 10, py + 18, py - 25, py + 33].find(free) ?? (chosen ? py - 10 : null);
      if (y === null) return;
      placed.push({ x, y, width });
      context.strokeText(label, x, y);
      context.fillStyle = car.blind ? colour.none : colour.text;
      context.fillText(label, x, y);
    });
  }

  drawCandidate(context, { pose, number }, pixel, colour) {
    context.save();
    context.translate(pose.x, pose.y);
    context.strokeStyle = colour.warn;
    context.lineWidth = 2 * pixel;
    context.fillStyle = colour.ground;
    context.beginPath();
    context.moveTo(0, 0);
    context.lineTo(26 * pixel * Math.cos(pose.heading), 26 * pixel * Math.sin(pose.heading));
    context.stroke();
    context.beginPath();
    context.arc(0, 0, 11 * pixel, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    context.scale(pixel, -pixel);
    context.font = "700 13px system-ui, sans-serif";
    context.textAlign = "center";
    context.fillStyle = colour.warn;
    context.fillText(String(number), 0, 5);
    context.restore();
  }

  drawPlacing(context, colour) {
    const { from, to } = this.drag;
    context.strokeStyle = colour.warn;
    context.fillStyle = colour.warn;
    context.lineWidth = 3;
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
    context.beginPath();
    context.arc(...from, 6, 0, 2 * Math.PI);
    context.fill();
  }
}
