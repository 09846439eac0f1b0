// The page around the terminal: says when its picture is old, keeps the keys in the terminal.
"use strict";

const BEAT = 200; // between two beats [ms]
const STALE = 500; // a picture older than this is marked [ms]
const EMERGENCY = "To stop: the emergency stop, or `bramah stop` on the bench's computer.";
let connected = false; // before that the terminal's script cannot tell its server of the focus
const connection = document.getElementById("connection");
const keys = document.getElementById("keys");

function show(notice, text) {
  if (notice.textContent !== text && text) notice.textContent = text;
  const shown = notice.classList.contains("shown");
  notice.classList.toggle("shown", Boolean(text));
  if (shown !== Boolean(text) && connected) window.dispatchEvent(new Event("resize")); // fits the terminal
}

// A beat goes through the server and the screen's own loop, and comes back behind every frame that
// was drawn before it. How long ago the newest one was sent is therefore how old the picture may be.
function watch(socket) {
  let newest = null; // when the newest beat that came back was sent [ms]
  let ended = "";
  let beating = null;
  const look = () => {
    if (ended) return;
    socket.send(JSON.stringify(["beat", String(performance.now())]));
    if (newest === null) return;
    const age = performance.now() - newest;
    const old = age > STALE + BEAT;
    document.body.classList.toggle("old", old);
    show(connection, old
      ? `◌ STALE: this picture is ${(age / 1000).toFixed(1)} s old; the connection is slow or lost. ${EMERGENCY}`
      : "");
  };
  socket.addEventListener("open", () => {
    connected = true;
    beating = setInterval(look, BEAT);
  });
  socket.addEventListener("message", (event) => {
    if (typeof event.data !== "string") return;
    const [kind, value] = JSON.parse(event.data);
    if (kind === "beat") newest = Number(value);
    if (kind === "ended") ended = value;
  });
  socket.addEventListener("close", () => {
    connected = false;
    clearInterval(beating);
    document.body.classList.add("old");
    show(connection, ended || `⊘ DISCONNECTED: this picture is old; a run goes on unseen. ${EMERGENCY}`);
    const again = document.createElement("a");
    again.href = window.location.href;
    again.textContent = "open the screen again";
    connection.append(" ", again);
  });
}

const Native = window.WebSocket;
window.WebSocket = class extends Native {
  constructor(...words) {
    super(...words);
    watch(this);
  }
};

// Keys belong to the terminal, whatever was clicked.
function keep() {
  const input = document.querySelector(".xterm-helper-textarea");
  if (connected && input && document.activeElement !== input) input.focus();
  show(keys, document.hasFocus() || !connected ? "" : "▲ KEYS GO ELSEWHERE: click into this page, or SPACE does not stop");
}
setInterval(keep, BEAT);
for (const name of ["focus", "blur", "click"]) window.addEventListener(name, keep);

// The terminal measures its font once, when it starts: the fonts must be there by then.
const fonts = ["16px", "bold 16px"].map((font) => document.fonts.load(`${font} "Roboto Mono"`, "A⠃"));
const loaded = new Promise((resolve) => window.addEventListener("load", resolve, { once: true }));
Promise.allSettled([loaded, ...fonts]).then(() => {
  const script = document.createElement("script");
  script.src = document.body.dataset.terminal;
  script.onload = () => window.onload(new Event("load")); // it sets this and waits for the event
  script.onerror = () => show(connection, "⊘ The terminal's script did not load; open the page again.");
  document.head.append(script);
});
