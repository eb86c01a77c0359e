// The connection to the pit wall's program: snapshots in, commands out.

/// Calls `onSnapshot` for each snapshot and `onLink` with true or false; dials again for ever.
export function connect(onSnapshot, onLink) {
  let socket = null;
  let selected = null;
  let retry = 200;
  const tell = () => {
    if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ select: selected }));
  };
  const dial = () => {
    socket = new WebSocket(`ws://${location.host}/ws`);
    socket.onopen = () => { retry = 200; tell(); onLink(true); };
    socket.onmessage = (message) => onSnapshot(JSON.parse(message.data));
    socket.onclose = () => {
      onLink(false);
      setTimeout(dial, retry);
      retry = Math.min(retry * 2, 3000);
    };
  };
  dial();
  return { select(car) { selected = car; tell(); } };
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
    return { ok: false, status: 0, body: "the pit wall's program does not answer" };
  }
}

/// A fresh command id: sent twice, a command is done once.
export function newId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((b) => b.toString(16).padStart(2, "0")).join("");
}

/// Gives a car a command. Resolves to {done, text, verdict}. What got lost between this page and the program is
/// sent once more with the same id.
export async function command(car, operator, action, expected = null) {
  const request = { car, operator, expected_revision: expected, id: newId(), action };
  let reply = await post("/command", request);
  if (reply.status === 0) reply = await post("/command", request);
  return reply.ok ? reply.body : { done: false, text: `${car}: ${reply.body}`, verdict: null };
}
