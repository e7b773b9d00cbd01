// The page: what is dragged goes to the server as a request, its answer becomes the picture. One
// request is under way at a time; inputs meanwhile are in the next. When nothing is dragged, there
// is no timer and no request.
import { draw, fitted, toPlane, toScreen, unpacked } from "/draw.js";

const $ = (id) => document.getElementById(id);
const copy = (value) => JSON.parse(JSON.stringify(value));
let hello, socket, state, view, picture = null, stale = false;
let busy = false, wanted = false, number = 0, begin = false;
let driving = null, verifying = 0, verifies = "", rest = null, riskPrice = 0, drawing = false;
const undo = [];
// When inputs arrived that no request has, that the request under way has, and that were drawn.
let waiting = [], sent = [];
// For the benchmark: milliseconds from input to picture, and when pictures were drawn.
const measured = { latencies: [], drawn: [], answers: 0, quick: 0,
  get settled() { return !busy && !wanted && !verifying && !rest && !drawing && Boolean(picture); } };
window.slipcarLive = measured;

// ------------------------------------------------------------------------------------- socket

function connect() {
  socket = new WebSocket(`${location.origin.replace("http", "ws")}/socket`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => (typeof data === "string" ? greet(JSON.parse(data)) : answer(data));
  socket.onclose = () => {
    stop();
    busy = false; verifying = 0;
    say("banner", "The server does not answer. This page tries again when you come back to it or " +
      "move something; start it by: slipcar live");
  };
}

function greet(told) {
  say("banner", "");
  if (hello) ask();
  else { hello = told; begun(); }
}

function request(extra = {}) {
  const { system, world, mode, price, risk, policy } = state;
  const asked = mode === "drive" && !driving ? "feedback" : mode;
  return JSON.stringify({ id: ++number, system, world, mode: asked, risk, policy,
    price: mode === "risk" ? riskPrice : price, ...extra });
}

// Milliseconds of planning beyond which drags are answered by quick plans, the whole at rest.
const SLOW = 60;
let slow = false, waits = null;

function ask() {
  if (!socket || socket.readyState > 1) { connect(); return; }
  if (socket.readyState !== 1 || !hello) return;
  if (busy) { wanted = true; return; }
  busy = true; wanted = false;
  sent = waiting; waiting = [];
  waits = setTimeout(() => { $("status").textContent = "planning …"; }, 400);
  socket.send(request({ quick: slow && !driving, begin, seed: begin ? Math.floor(1e6 * Math.random()) : 0 }));
  begin = false;
}

function answer(buffer) {
  const got = unpacked(buffer);
  if (got.facts.id === verifying) { verified(got); return; }
  busy = false;
  clearTimeout(waits);
  paced(got.facts);
  measured.answers += 1;
  measured.quick += got.facts.quick ? 1 : 0;
  const inputs = sent;
  sent = [];
  if (wanted) ask();
  complain(got.facts.error || "");
  stale = Boolean(got.facts.error);
  // A slow first plan may have compiled: whether whole plans are slow, the next one tells.
  if (slow && !driving) { clearTimeout(rest); rest = setTimeout(verify, 400); }
  if (!stale) { picture = got; numbers(got.facts); }
  if (driving) driven(got.facts);
  show(inputs);
}

// ------------------------------------------------------------------------------------- changes

// Something was changed; `remember` is called before, for Undo.
function changed(event) {
  waiting.push(event && event.timeStamp ? event.timeStamp : performance.now());
  clearTimeout(rest);
  rest = state.mode === "risk" ? setTimeout(verify, 400) : null;
  place(); show([]);
  if (!driving) ask();  // the next tick takes it along
}

function remember() {
  const now = JSON.stringify(state);
  if (undo[undo.length - 1] !== now) undo.push(now);
  if (undo.length > 200) undo.shift();
  $("undo").disabled = undo.length === 0;
}

function verify() {
  if (driving) { rest = null; return; }
  if (verifying || busy || socket.readyState !== 1) { rest = setTimeout(verify, 200); return; }
  rest = null;
  const risk = state.mode === "risk";
  socket.send(request({ verify: risk }));
  verifying = number;
  verifies = JSON.stringify(state);
  $("status").textContent = risk ? "verifying the risk …" : "planning thoroughly …";
}

// Whether whole plans of this world are too slow to drag by; a drag of another may be faster.
function paced(facts) {
  if (facts.plan_ms && !facts.quick) slow = facts.plan_ms > SLOW;
}

function verified(got) {
  verifying = 0;
  if (state.mode !== "risk") paced(got.facts);
  if (got.facts.error) { complain(got.facts.error); return; }
  const { verified: found } = got.facts;
  if (found && Number.isFinite(found.price)) riskPrice = found.price;
  if (verifies !== JSON.stringify(state)) return;  // dragged on meanwhile
  picture = got;
  numbers(got.facts); show([]);
}

function load(world, keep = false) {
  if (!keep) remember();
  state.system = hello.car; state.world = copy(world);
  rebuild();
}

function rebuild() {
  stop();
  for (const part of document.querySelectorAll(".car")) part.hidden = state.system !== hello.car;
  fit(); handles(); controls(); changed();
}

// ------------------------------------------------------------------------------------- handles

function fit() {
  const box = $("stage").getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
  $("canvas").width = box.width * ratio; $("canvas").height = box.height * ratio;
  const { start, goal, obstacles = [] } = state.world, [i, j] = plane();
  const points = [start, goal].filter(Boolean).map((p) => [p[i], p[j]]).concat(obstacles);
  view = fitted(points, box.width, box.height);
}

const plane = () => (state.system === hello.car ? [0, 1] : hello.systems[state.system].plane);
const movable = () => (state.system === hello.car ? ["start", "goal", "obstacles"]
  : hello.systems[state.system].draggable);

// All handles: where they are, how they move, what they are called.
function spots() {
  const [i, j] = plane(), w = state.world, found = [];
  const at = (p) => ({ get: () => [p[i], p[j]], set: (x, y) => { p[i] = x; p[j] = y; } });
  for (const name of ["start", "goal"]) {
    if (!w[name] || !movable().includes(name)) continue;
    found.push({ kind: name, key: name, text: name[0].toUpperCase(), ...at(w[name]) });
    if (state.system !== hello.car) continue;
    const p = w[name];
    found.push({ kind: "turn", key: `${name}-heading`, text: "", owner: name,
      get: () => [p[0] + 0.4 * Math.cos(p[2]), p[1] + 0.4 * Math.sin(p[2])],
      set: (x, y) => {
        const turn = Math.atan2(y - p[1], x - p[0]);
        p[2] = turn + 2 * Math.PI * Math.round((p[2] - turn) / (2 * Math.PI));
      } });
  }
  if (movable().includes("obstacles")) {
    (w.obstacles || []).forEach((o, index) => found.push({ kind: "obstacle", index,
      key: `obstacles[${index}]`, text: String(index + 1),
      get: () => [o[0], o[1]], set: (x, y) => { o[0] = x; o[1] = y; },
      grow: (by) => { o[2] = Math.max(0.05, o[2] + by); } }));
  }
  return found;
}

function handles(focus = "") {
  $("obstacle-row").hidden = true;
  const box = $("handles");
  box.replaceChildren(...spots().map((spot) => {
    const button = document.createElement("button");
    button.className = `handle ${spot.kind}`;
    button.textContent = spot.text;
    button.dataset.key = spot.key;
    button.spot = spot;
    button.addEventListener("pointerdown", grab);
    button.addEventListener("focus", () => chosen(spot));
    button.addEventListener("keydown", key);
    return button;
  }));
  place();
  if (focus) box.querySelector(`[data-key="${focus}"]`)?.focus();
}

// The obstacle that was touched last can be resized and removed without a keyboard.
let obstacle = null;
function chosen(spot) {
  if (spot.kind !== "obstacle") return;
  obstacle = spot;
  $("obstacle-row").hidden = false;
  $("obstacle-name").textContent = `Obstacle ${spot.index + 1}`;
}
function grow(spot, by, event) { remember(); spot.grow(by); changed(event); }
function drop(spot, event) {
  if (state.system !== hello.car) return;
  remember();
  state.world.obstacles.splice(spot.index, 1);
  handles("goal");
  changed(event);
}
$("smaller").onclick = (e) => grow(obstacle, -0.02, e);
$("larger").onclick = (e) => grow(obstacle, 0.02, e);
$("remove").onclick = (e) => drop(obstacle, e);

function place() {
  for (const button of $("handles").children) {
    const [x, y] = button.spot.get(), [px, py] = toScreen(view, x, y);
    button.style.transform = `translate(${px}px, ${py}px)`;
    const { kind, owner, index } = button.spot;
    const what = kind === "turn" ? `heading of the ${owner}` : kind === "obstacle" ? `obstacle ${index + 1}` : kind;
    button.setAttribute("aria-label", `${button.textContent} ${what} at ${x.toFixed(2)}, ${y.toFixed(2)} m`.trim());
  }
  for (const name of ["slip", "price", "risk", "horizon", "clearance"]) write(name);
}

function grab(event) {
  const button = event.currentTarget, box = $("stage").getBoundingClientRect();
  const [x, y] = toScreen(view, ...button.spot.get());
  const off = [event.clientX - box.left - x, event.clientY - box.top - y];
  remember(); chosen(button.spot);
  button.setPointerCapture(event.pointerId);
  button.onpointermove = (e) => {
    button.spot.set(...toPlane(view, e.clientX - box.left - off[0], e.clientY - box.top - off[1]));
    changed(e);
  };
  button.onpointerup = button.onpointercancel = () => { button.onpointermove = null; };
}

function key(event) {
  const { spot } = event.currentTarget, step = event.shiftKey ? 0.01 : 0.05;
  const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  const [x, y] = spot.get();
  const grow = { "+": 0.02, "=": 0.02, "-": -0.02, "−": -0.02 }[event.key];
  if (event.key === "Delete" && spot.kind === "obstacle") { drop(spot, event); return; }
  if (moves[event.key]) { remember(); spot.set(x + moves[event.key][0], y + moves[event.key][1]); }
  else if (grow && spot.grow) { remember(); spot.grow(grow); }
  else return;
  event.preventDefault();
  changed(event);
}

// ------------------------------------------------------------------------------------- controls

const sliders = {
  slip: [() => state.world.slip?.[0], (v) => { state.world.slip = [v, v / 10]; }],
  price: [() => (state.mode === "risk" ? riskPrice : state.price), (v) => { state.price = v; }],
  risk: [() => Math.log10(state.risk), (v) => { state.risk = Number((10 ** v).toPrecision(2)); }],
  horizon: [() => state.world.horizon, (v) => { state.world.horizon = v; }],
  clearance: [() => state.world.clearance, (v) => { state.world.clearance = v; }],
};

function write(name) {
  const value = sliders[name][0]();
  if (value === undefined) return;
  if (document.activeElement !== $(name)) $(name).value = value;
  $(`${name}-value`).textContent = name === "risk" ? percent(state.risk) : String(Number(value.toFixed(2)));
}

function controls() {
  for (const input of document.querySelectorAll("#modes input")) input.checked = input.value === state.mode;
  $("risk-row").hidden = state.mode !== "risk";
  $("price").disabled = state.mode === "risk";
  $("drive-row").hidden = state.mode !== "drive" || state.system !== hello.car;
  $("policy").value = state.policy;
  $("undo").disabled = undo.length === 0;
}

function begun() {
  const same = (world) => JSON.stringify(world) === JSON.stringify(hello.first);
  const first = Object.keys(hello.scenarios).find((name) => same(hello.scenarios[name]));
  const names = [...(first ? [] : ["the first one"]), ...Object.keys(hello.scenarios)];
  $("world").replaceChildren(...names.map((name) => new Option(name, name)),
    ...Object.keys(hello.systems).map((name) => new Option(name, `system:${name}`)));
  $("world").value = first || "the first one";
  $("world").onchange = () => choose($("world").value);
  for (const [mode, name] of Object.entries(hello.modes)) {
    const label = document.createElement("label"), input = document.createElement("input");
    Object.assign(input, { type: "radio", name: "mode", value: mode });
    input.onchange = (e) => { remember(); stop(); state.mode = mode; controls(); changed(e); };
    label.append(input, name);
    $("modes").append(label);
  }
  for (const name of hello.policies) $("policy").append(new Option(name, name));
  $("policy").onchange = (e) => { remember(); state.policy = $("policy").value; changed(e); };
  for (const [name, [, set]] of Object.entries(sliders)) {
    $(name).onpointerdown = remember;
    $(name).onkeydown = (e) => { if (e.key.startsWith("Arrow")) remember(); };
    $(name).oninput = (e) => { set(Number($(name).value)); changed(e); };
  }
  state = { system: hello.car, world: copy(hello.first), mode: "feedback", price: 0, risk: 0.01, policy: "" };
  fromLink();
  rebuild();
  undo.length = 0; controls();
}

function choose(value) {
  remember();
  const own = value.startsWith("system:") ? value.slice(7) : "";
  state.system = own || hello.car;
  state.world = copy(own ? hello.systems[own].world : hello.scenarios[value] || hello.first);
  if (own && state.mode === "drive") state.mode = "feedback";
  rebuild();
}

function fromLink() {
  if (location.hash.length < 2) return;
  try {
    const linked = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    const car = linked.system === hello.car;
    if (!linked.world || !(car || hello.systems[linked.system])) throw new Error("not of this page");
    const names = ["start", "goal", ...(linked.world.obstacles ? ["obstacles"] : [])];
    if (!names.every((name) => Array.isArray(linked.world[name]))) throw new Error("no world in it");
    for (const name of Object.keys(state)) if (name in linked) state[name] = linked[name];
  } catch (error) { say("banner", `The link could not be read: ${error.message}`); }
}

$("undo").onclick = back;
$("reset").onclick = () => choose($("world").value);
$("add").onclick = (event) => {
  remember();
  const box = $("stage").getBoundingClientRect();
  state.world.obstacles.push([...toPlane(view, box.width / 2, box.height / 2).map((v) => Number(v.toFixed(2))), 0.2]);
  handles(`obstacles[${state.world.obstacles.length - 1}]`);
  changed(event);
};
$("theme").onclick = () => dark(!document.documentElement.classList.contains("dark"));
function dark(on) {
  document.documentElement.classList.toggle("dark", on);
  $("theme").setAttribute("aria-pressed", String(on));
  if (view) show([]);
}
dark(matchMedia("(prefers-color-scheme: dark)").matches);

function back() {
  if (!undo.length) return;
  state = JSON.parse(undo.pop());
  rebuild();
}
addEventListener("keydown", (e) => {
  if ((e.ctrlKey || e.metaKey) && e.key === "z") { e.preventDefault(); back(); }
});
addEventListener("resize", () => { if (state) { fit(); place(); show([]); } });
addEventListener("focus", () => { if (socket && socket.readyState > 1) connect(); });

for (const button of $("copies").querySelectorAll("button")) {
  button.onclick = async () => {
    const texts = {
      link: `${location.origin}${location.pathname}#${encodeURIComponent(JSON.stringify(state))}`,
      json: JSON.stringify(state.world, null, 1),
      python: picture ? picture.facts.python || "" : "",
    };
    const text = texts[button.dataset.copy];
    $("text").hidden = false; $("text").value = text;
    try { await navigator.clipboard.writeText(text); $("copied").textContent = "copied"; }
    catch { $("text").select(); $("copied").textContent = "selected: copy it"; }
  };
}

// ------------------------------------------------------------------------------------- driving

$("drive").onclick = () => {
  if (driving) { stop(); return; }
  driving = { timer: null }; begin = true;
  $("drive").textContent = "Stop";
  ask();
};

function driven(facts) {
  clearTimeout(driving.timer);
  // The car waits while the world is one that cannot be planned for.
  if (facts.error) { driving.timer = setTimeout(ask, 250); return; }
  const d = facts.drive;
  if (!d) { driving.timer = setTimeout(ask, 0); return; }  // an older answer
  $("drive-state").textContent = `step ${d.step} of ${d.steps}${d.collided ? ", collided" : ""}` +
    (d.done ? `; ${d.arrived ? "arrived" : "not arrived"}, ${d.off.toFixed(2)} m off` : "");
  if (d.done) stop();
  else driving.timer = setTimeout(ask, 1e3 * d.dt);
}

function stop() {
  if (driving) clearTimeout(driving.timer);
  driving = null;
  $("drive").textContent = "Drive";
}

// ------------------------------------------------------------------------------------- words

const percent = (p) => `${digits(p)} %`;
const digits = (p) => Number((100 * p).toPrecision(2));
const range = (p, [low, high]) => `${digits(p)} [${digits(low)}, ${digits(high)}] %`;

function numbers(f) {
  const rows = [];
  const costs = Object.entries(f.cost).filter(([name, v]) => v || name !== "running");
  for (const [name, v] of costs) rows.push([name, v.toFixed(3)]);
  rows.push(["total", costs.reduce((sum, [, v]) => sum + v, 0).toFixed(3)]);
  rows.push(["iterations", f.iterations]);
  if (f.predicted !== null) rows.push(["risk, predicted at most", percent(f.predicted)]);
  if (f.hits !== null) rows.push([`risk${f.drive ? " from here" : ""}, ${f.paths} paths`, range(f.hits / f.paths, f.interval)]);
  if (f.verified) {
    rows.push([`risk, ${f.verified.episodes} fresh paths`, range(f.verified.rate, f.verified.interval)]);
    rows.push(["price found", f.verified.price.toFixed(2)]);
  }
  if (f.policy) rows.push([f.policy.name, range(f.policy.hits / f.policy.paths, f.policy.interval)]);
  if (f.plan_ms) rows.push(["planned in", `${f.plan_ms.toFixed(1)} ms`]);
  $("numbers").replaceChildren(...rows.flatMap(([name, value]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
  const kept = f.verified && !f.verified.reached ? `no plan keeps ${percent(f.verified.requested)}` : "";
  const said = [f.status, f.message, kept].filter(Boolean).join("; ");
  $("status").className = f.ok && !kept ? "" : "bad";
  if ($("status").textContent !== said) $("status").textContent = said;
}

function say(id, text) {
  $(id).hidden = !text;
  if ($(id).textContent !== text) $(id).textContent = text;
}

// What is wrong, where it is wrong: errors begin with the name of the field.
function complain(error) {
  const field = /^(\w+)(\[\d+\])?/.exec(error), name = field ? field[1] : "";
  for (const slider of Object.keys(sliders)) {
    const here = error && slider === name;
    say(`${slider}-error`, here ? error : "");
    $(slider).setAttribute("aria-invalid", String(Boolean(here)));
    if (here) $(slider).setAttribute("aria-describedby", `${slider}-error`);
    else $(slider).removeAttribute("aria-describedby");
  }
  let bad = null;
  for (const button of $("handles").children) {
    const here = Boolean(error) && [name, `${name}${field?.[2] || ""}`].includes(button.dataset.key);
    button.classList.toggle("bad", here);
    if (here) bad = button;
  }
  say("bubble", bad ? error : "");
  if (bad) {
    const [px, py] = toScreen(view, ...bad.spot.get()), box = $("stage").getBoundingClientRect();
    $("bubble").style.left = `${Math.max(0, Math.min(px + 20, box.width - 300))}px`;
    $("bubble").style.top = `${Math.max(0, Math.min(py + 20, box.height - 120))}px`;
  }
  if (error && !bad && !(name in sliders)) {
    $("status").className = "bad"; $("status").textContent = error;
  }
}

// ------------------------------------------------------------------------------------- picture

// Draw at the next frame; `inputs` are answered by what is drawn then.
let answered = [];
function show(inputs) {
  answered.push(...inputs);
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    draw($("canvas"), view, state.world, state.world.clearance, picture, stale);
    const now = performance.now();
    if (answered.length) {
      measured.latencies.push(...answered.map((t) => now - t));
      measured.drawn.push(now);
      answered = [];
      for (const list of [measured.latencies, measured.drawn]) if (list.length > 5000) list.splice(0, 2500);
      const latest = measured.drawn.slice(-20);
      const rate = latest.length > 1 ? 1e3 * (latest.length - 1) / (latest.at(-1) - latest[0]) : 0;
      if (now - latest[0] < 2000 && rate > 1) {
        $("speed").textContent = `${rate.toFixed(0)} updates a second; ` +
          `${measured.latencies.at(-1).toFixed(0)} ms from input to picture`;
      }
    }
  });
}

connect();
