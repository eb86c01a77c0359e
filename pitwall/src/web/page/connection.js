// The connection to the pit wall's program: snapshots in, commands out.

/// Without a snapshot for this long, what the page shows is old [ms].
const SILENT = 1000;

/// Calls `onSnapshot` for each snapshot, and `onLink` with the state of the connection twice a second and at each
/// change: {up, silent_s, rate}. Reconnects for ever.
export function connect(onSnapshot, onLink, onRefused) {
  let socket = null;
  let settings = { select: null, operator: null };
  let retry = 200;
  let heard = performance.now();
  let open = false;
  let times = [];
  const sendSettings = () => {
    if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(settings));
  };
  const report = () => {
    const now = performance.now();
    while (times.length && times[0] < now - 2000) times.shift();
    const silent = now - heard;
    onLink({ up: open && silent < SILENT, silent_s: silent / 1000, rate: times.length / 2 });
  };
  const dial = () => {
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
    socket.onopen = () => { retry = 200; open = true; heard = performance.now(); sendSettings(); report(); };
    socket.onmessage = (message) => {
      const snapshot = JSON.parse(message.data);
      heard = performance.now();
      times.push(heard);
      onSnapshot(snapshot);
    };
    socket.onclose = () => {
      if (!open) fetch("/snapshot").then((r) => r.status === 401 && onRefused()).catch(() => {});
      open = false;
      report();
      setTimeout(dial, retry);
      retry = Math.min(retry * 2, 3000);
    };
  };
  dial();
  setInterval(report, 500);
  return {
    select(car) { settings.select = car; sendSettings(); },
    operator(name) { settings.operator = name; sendSettings(); },
    /// Asks for the next snapshot: none is sent while one waits to be drawn.
    drawn(number) { if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ drawn: number })); },
  };
}

/// Sends a request; resolves to {ok, status, body}. `body` is JSON where the answer is, else text.
export async function post(path, content) {
  try {
    const response = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(content),
    });
    const text = await response.text();
    let body = text;
    try { body = JSON.parse(text); } catch { /* it is text */ }
    return { ok: response.ok, status: response.status, body };
  } catch {
    return { ok: false, status: 0, body: "the pit wall does not answer" };
  }
}

/// A new command id: a command that is sent twice is executed once.
export function newId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((b) => b.toString(16).padStart(2, "0")).join("");
}

/// Sends a command to a car. Resolves to {done, text, verdict}. A request that is lost on the way to the program is sent
/// once more with the same id.
export async function command(car, operator, action, expected = null) {
  const request = { car, operator, expected_revision: expected, id: newId(), action };
  let reply = await post("/command", request);
  if (reply.status === 0) reply = await post("/command", request);
  return reply.ok ? reply.body : { done: false, text: `${car}: ${reply.body}`, verdict: null };
}
