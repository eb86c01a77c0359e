// Small plots of a value over the last two minutes.

import { palette } from "/track.js";
import { STATES } from "/cards.js";

export const SPAN_S = 120;

/// Draws `points`, each {at [s], state, ...}, on a canvas. `value(point)` is between `low` and `high`; `limits` are
/// drawn as lines. The line has the colour of the state at the time.
export function plot(canvas, points, now, { value, low, high, limits = [] }) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  const colours = palette();
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const x = (at) => width - (now - at) / SPAN_S * width;
  const y = (v) => height - 2 - (Math.min(Math.max(v, low), high) - low) / (high - low) * (height - 4);
  context.strokeStyle = colours.edge;
  context.lineWidth = 1;
  context.setLineDash([3, 3]);
  for (const limit of limits) {
    context.beginPath();
    context.moveTo(0, y(limit));
    context.lineTo(width, y(limit));
    context.stroke();
  }
  context.setLineDash([]);
  context.lineWidth = 2;
  let before = null;
  let colour = null;
  for (const point of points) {
    const v = value(point);
    if (v === null || v === undefined) { before = null; continue; }
    // The line is interrupted during a pause.
    if (before && point.at - before.at < 2.5) {
      const next = colours[(STATES[point.state] ?? STATES.INIT)[1]];
      if (next !== colour) {
        if (colour) context.stroke();
        colour = next;
        context.strokeStyle = colour;
        context.beginPath();
        context.moveTo(x(before.at), y(before.v));
      }
      context.lineTo(x(point.at), y(v));
    } else {
      context.moveTo(x(point.at), y(v));
    }
    before = { at: point.at, v };
  }
  if (colour) context.stroke();
}
