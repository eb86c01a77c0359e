// The sessions in the recordings folder: searched, and opened for replay in a tab of their own.

import { post } from "/connection.js";
import { element, fixed } from "/cards.js";

/// Time between two looks while the index is brought up to date [ms].
const AGAIN = 700;

const COLUMNS = [
  ["date", (s) => s.started ? new Date(s.started / 1e6).toLocaleString() : "–"],
  ["length", (s) => `${Math.floor(s.duration_s / 60)}:${String(Math.floor(s.duration_s % 60)).padStart(2, "0")}`],
  ["track", (s) => s.track ?? "–"],
  ["cars", (s) => s.cars.join(", ")],
  ["laps", (s) => String(s.laps)],
  ["best lap", (s) => s.best_lap ? `${fixed(s.best_lap[1], 2, " s")} ${s.best_lap[0]}` : "–"],
  ["sets", (s) => s.sets.join(", ")],
  ["missing", (s) => s.error ? "DAMAGED" : !s.complete ? "not ended" : s.missing ? String(s.missing) : "nothing"],
  ["file", (s) => s.file + (s.on_car ? " (on the car)" : "")],
];

export class SessionDialog {
  /// `dialog` has the elements for the words, the table and what is to be said.
  constructor(dialog, { words, table, said }) {
    Object.assign(this, { dialog, words, table, said });
    words.addEventListener("input", () => this.look());
    dialog.addEventListener("close", () => clearTimeout(this.timer));
  }

  open() {
    this.dialog.showModal();
    this.words.focus();
    this.look();
  }

  async look() {
    clearTimeout(this.timer);
    const text = this.words.value;
    const response = await fetch(`/sessions?text=${encodeURIComponent(text)}`).catch(() => null);
    if (!this.dialog.open || text !== this.words.value) return;
    if (!response?.ok) {
      this.said.textContent = response ? await response.text() : "the pit wall does not answer";
      return;
    }
    const { sessions, reading, fault } = await response.json();
    this.show(sessions);
    const count = sessions.length === 1 ? "1 session" : `${sessions.length} sessions`;
    this.said.textContent = fault ?? (reading ? `${count}; reading the folder` : count);
    if (reading) this.timer = setTimeout(() => this.look(), AGAIN);
  }

  show(sessions) {
    const key = JSON.stringify(sessions);
    if (this.shown === key) return;
    this.shown = key;
    const head = element("tr");
    for (const [name] of COLUMNS) head.append(element("th", "", name));
    head.append(element("th"));
    this.table.replaceChildren(head, ...sessions.map((session) => {
      const row = element("tr");
      for (const [, text] of COLUMNS) row.append(element("td", "", text(session)));
      row.title = [session.error, ...session.markers].filter(Boolean).join("\n");
      const button = element("button", "", "replay");
      button.addEventListener("click", () => this.replay(session, button));
      const cell = element("td");
      cell.append(button);
      row.append(cell);
      return row;
    }));
  }

  /// The tab is opened at once: later the browser would take it for an advertisement.
  async replay(session, button) {
    const tab = window.open("about:blank");
    button.disabled = true;
    const { ok, body } = await post("/sessions/open", { file: session.file });
    button.disabled = false;
    if (ok) {
      // A pit wall that listens on every address does not know which of them leads here.
      const url = new URL(body.url);
      url.hostname = location.hostname;
      body.url = url.href;
    }
    if (ok && tab) tab.location = body.url;
    else {
      tab?.close();
      this.said.textContent = ok ? `open ${body.url}` : body;
    }
  }
}
