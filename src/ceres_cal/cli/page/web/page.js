// The page: what the server says is shown, what somebody does is said to the server. Nothing is decided here.

import { View } from "./view.js";
import { Panel } from "./panel.js";

const $ = id => document.getElementById(id);
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const SIDES = ["right", "bottom-right", "bottom", "bottom-left", "left", "top-left", "top", "top-right"];

let now = null; // all that the server said last
let socket = null, waiting = false, next = null;
let selected = null, photograph = 0, withResiduals = false, advised = null, saw = false;
let sent = 0, asked = null;
const pictures = new Map(), latencies = [];

const view = new View($("stage"), $("view"), $("lens"), {
  select(name) { selected = name; refresh(); },
  drag(handle, [x, y], last) {
    const message = { do: "drag", what: handle.what, name: handle.name, x, y, sigma: view.sigma, last };
    if (handle.number !== undefined && handle.number !== null) message.number = handle.number;
    else if (handle.what === "place" && !last) handle.number = now.state.places.length;
    if (handle.what === "place" && handle.number !== undefined && handle.number !== null) message.number = handle.number;
    dragged(message);
  },
  click(pixel) {
    if (view.tool === "goal") return facing(pixel);
    if (selected && !(selected in now.state.points)) return dragged({ do: "drag", what: "point", name: selected, x: pixel[0], y: pixel[1], sigma: view.sigma, last: true });
    selected = null;
    refresh();
  },
  region(box) {
    change({ regions: [...now.state.regions, { photograph: now.photographs[photograph].name, box }] });
    tool(null);
  },
  painted() {
    if (asked === null) return;
    latencies.push(performance.now() - asked); // from a drag to the model that follows it, drawn
    asked = null;
  },
});

const panel = new Panel({
  change,
  select(name) { selected = name; const place = now.model.points[name]; if (place && place[0] !== null) view.bring(place); refresh(); $("view").focus(); },
  advise(shapes) { advised = shapes; refresh(); },
});

// ---- the server ----

function connect() {
  socket = new WebSocket(new URL("socket", location.href.replace(/^http/, "ws")));
  socket.onmessage = event => receive(JSON.parse(event.data));
  socket.onclose = () => {
    document.body.classList.add("ended");
    say("The page has ended. What was written stays; `ceres-cal open` with the same folder goes on from here.");
  };
}
function send(message) { if (socket.readyState === 1) socket.send(JSON.stringify(message)); }
function change(parts) { send({ do: "change", revision: now.revision, state: { ...now.state, ...parts } }); }
function press(what) { send({ do: "now", what, photograph }); }

// One drag is on its way at a time; of those meanwhile the last one counts.
function dragged(message) {
  if (waiting) next = message;
  else { waiting = true; sent = performance.now(); send(message); }
  local(message);
}
function answered() {
  waiting = false;
  const message = next;
  next = null;
  if (message) dragged(message);
}
// What is dragged is drawn where it is at once, before the model follows.
function local(message) {
  const one = view.clicks.find(click => click.what === message.what && (message.what === "point" ? click.name === message.name : click.number === message.number));
  if (one) [one.x, one.y] = [message.x, message.y];
  else if (message.what === "point") {
    const points = Object.keys(now.state.points).length;
    view.clicks.splice(points, 0, { what: "point", name: message.name, x: message.x, y: message.y });
  } else view.clicks.push({ what: "place", name: message.name, number: message.number, x: message.x, y: message.y });
  view.draw();
}

function receive(message) {
  if (message.is === "model") {
    view.model = message;
    asked = sent;
    view.draw();
    return answered();
  }
  if (message.is === "refused") {
    say(message.why);
    refresh();
    return answered();
  }
  now = message;
  say(now.message);
  if (Object.keys(now.checked).length && !saw) { // once: what the photograph was compared for
    saw = withResiduals = true;
    $("residuals").setAttribute("aria-pressed", true);
  }
  refresh();
  answered();
}

// ---- what is shown ----

function refresh() {
  if (!now) return;
  photograph = Math.min(photograph, now.photographs.length - 1);
  tabs();
  view.model = now.model;
  view.selected = selected;
  view.unpainted = new Set(now.state.not_painted);
  view.clicks = [
    ...Object.entries(now.state.points).map(([name, one]) => ({ what: "point", name, ...one })),
    ...now.state.places.map((one, number) => ({ what: "place", name: one.curve, number, x: one.x, y: one.y })),
  ].map(one => ({ ...one, ...against(one) }));
  const shown = now.photographs[photograph];
  view.regions = now.state.regions.filter(one => one.photograph === shown.name).map(one => one.box);
  view.strokes = withResiduals ? now.known?.residuals[shown.frame] ?? now.checked[shown.frame] ?? [] : [];
  view.enlarged = enlargement(view.strokes);
  view.layers = [
    { lines: now.placed[shown.frame] ?? [], colour: "model" },
    { lines: now.looked.other?.lines ?? [], colour: "before" },
  ];
  if (!now.found) advised = null;
  view.shapes = advised ?? [];
  $("undo").disabled = !now.undo || Boolean(now.busy);
  $("redo").disabled = !now.redo || Boolean(now.busy);
  $("residuals").disabled = !now.known && !Object.keys(now.checked).length;
  $("busy").hidden = !now.busy;
  $("busy-text").textContent = now.busy;
  panel.show(now, selected, photograph);
  hint();
  load();
  view.draw();
}
function against(one) {
  const off = now.against[one.what === "point" ? one.name : `#${one.number}`];
  return off === undefined ? { against: false } : { against: true, off };
}
function enlargement(strokes) {
  const lengths = strokes.filter(one => !one[4]).map(one => Math.hypot(one[2], one[3])).sort((a, b) => a - b);
  const typical = lengths[Math.floor(lengths.length / 2)] || 1, wanted = 0.015 * view.size[0] / typical;
  return [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].filter(one => one <= wanted).pop() ?? 1;
}
function tabs() {
  const names = now.photographs.map((one, number) => {
    const button = document.createElement("button");
    button.role = "tab";
    button.textContent = one.name;
    if (one.board) button.append(Object.assign(document.createElement("small"), { textContent: " board" }));
    button.setAttribute("aria-selected", number === photograph);
    button.tabIndex = number === photograph ? 0 : -1;
    button.onclick = () => { photograph = number; refresh(); };
    button.onkeydown = event => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      photograph = (photograph + step + now.photographs.length) % now.photographs.length;
      refresh();
      $("tabs").children[photograph].focus();
      event.preventDefault();
      event.stopPropagation();
    };
    return button;
  });
  const focused = $("tabs").contains(document.activeElement);
  $("tabs").replaceChildren(...names);
  if (focused) names[photograph].focus();
}
async function load() {
  const number = photograph, size = now.photographs[number].size;
  if (!pictures.has(number)) {
    pictures.set(number, null);
    const answer = await fetch(`photograph/${number}`);
    if (!answer.ok) return say(await answer.text());
    const picture = new Image();
    picture.src = URL.createObjectURL(await answer.blob());
    await picture.decode();
    pictures.set(number, picture);
  }
  if (number === photograph && pictures.get(number)) {
    if (view.picture !== pictures.get(number)) view.show(pictures.get(number), size);
  } else view.picture = null;
}
function hint() {
  if (!now) return;
  const shown = Object.keys(now.state.points).length, name = selected;
  let text = "";
  if (view.tool === "goal") text = `Click in the picture towards ${now.goal}.`;
  else if (view.tool === "mask") text = "Draw a box over what is not the field.";
  else if (withResiduals && view.strokes.length) text = `Residuals, ${view.enlarged} times enlarged.`;
  else if (!now.target) text = "Choose the field on the right.";
  else if (now.busy || now.found) text = "";
  else if (name && !(name in now.state.points)) text = `Click where ${name} is, or drag it there.`;
  else if (shown < 4) text = `Drag four corners or crossings of the model to where they are: ${shown} of 4.`;
  else text = "Drag whatever is off; then find the lines.";
  $("hint").textContent = $("message").hidden ? text : "";
}
function say(text) {
  $("goal").classList.toggle("wanted", text.includes("--facing"));
  // what a command's option would say is a button here
  $("message").textContent = text.replace(/: say which, such as --facing .*$/, `. Press “Where is ${now?.goal}?” and click there.`);
  $("message").hidden = !text;
  hint();
}
function tool(name) {
  view.tool = name;
  for (const one of ["mask", "goal"]) $(one).setAttribute("aria-pressed", name === one);
  $("view").classList.toggle("drawing", Boolean(name));
  hint();
}
// Which side of the picture a place lies towards, from its middle.
function facing([x, y]) {
  const [width, height] = view.size, angle = Math.atan2(y - height / 2, x - width / 2);
  const side = SIDES[(Math.round(angle / (Math.PI / 4)) + 8) % 8];
  tool(null);
  change({ facing: `${now.goal}=${side}` });
}

// ---- buttons and keys ----

$("undo").onclick = () => press("undo");
$("redo").onclick = () => press("redo");
$("fit").onclick = () => view.fit();
$("residuals").onclick = () => { withResiduals = !withResiduals; $("residuals").setAttribute("aria-pressed", withResiduals); refresh(); };
$("message").onclick = () => say("");
$("help").onclick = () => $("keys").showModal();
$("auto").onclick = () => press("auto");
$("find").onclick = () => press("find");
$("done").onclick = () => press("done");
$("end").onclick = () => press("end");
$("mask").onclick = () => tool(view.tool === "mask" ? null : "mask");
$("goal").onclick = () => tool(view.tool === "goal" ? null : "goal");
$("looking").addEventListener("click", event => event.target.id === "check" && press("check"));

const moving = { name: null, place: null, timer: 0 };
function nudge(step, event) {
  const shown = now.state.points[selected], at = moving.name === selected && moving.place ? moving.place : shown ? [shown.x, shown.y] : now.model.points[selected];
  if (!at || at[0] === null) return;
  const by = event.shiftKey ? 10 : event.altKey ? 0.1 : 1, place = [at[0] + by * step[0], at[1] + by * step[1]];
  Object.assign(moving, { name: selected, place });
  view.keyed = place;
  const message = { do: "drag", what: "point", name: selected, x: place[0], y: place[1], sigma: view.sigma };
  dragged({ ...message, last: false });
  clearTimeout(moving.timer);
  moving.timer = setTimeout(() => { moving.place = null; view.keyed = null; dragged({ ...message, last: true }); }, 350);
}
function choose(step) {
  const names = now.target?.points ?? [], at = names.indexOf(selected);
  if (names.length) panel.act.select(names[(at + step + names.length + (at < 0 && step < 0)) % names.length]);
}
function forget() {
  if (!selected || !(selected in now.state.points)) return;
  const { [selected]: _, ...points } = now.state.points;
  change({ points });
}
const KEYS = {
  n: () => choose(1), p: () => choose(-1), "+": () => view.zoom(1.25), "=": () => view.zoom(1.25), "-": () => view.zoom(0.8),
  0: () => view.fit(), f: () => press("find"), r: () => $("residuals").click(), "?": () => $("keys").showModal(),
  Delete: forget, Backspace: forget, Escape: () => { selected = null; tool(null); refresh(); },
};
addEventListener("keydown", event => {
  if (!now || event.target.closest("input, select, dialog")) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
    event.preventDefault();
    return press(event.shiftKey ? "redo" : "undo");
  }
  if (event.ctrlKey || event.metaKey) return;
  if (event.key in STEPS && event.target.id === "view") {
    event.preventDefault();
    return selected ? nudge(STEPS[event.key], event) : view.pan(-40 * STEPS[event.key][0], -40 * STEPS[event.key][1]);
  }
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act) { event.preventDefault(); act(); }
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => refresh());

connect();
window.page = { view, get now() { return now; }, press, change, latencies }; // for the tests, and for whoever is curious
