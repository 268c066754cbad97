// The page: what is chosen, how it is drawn, and what mouse, fingers and keys do.

const $ = id => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const STEPS = 65535, BARE = [150, 150, 155];             // colour of a body whose modulus is not known
const state = {object: 0, touch: 0, frame: 0, axis: 1, cut: 1, yaw: 1, pitch: 0.5, zoom: 1, shift: [0, 0]};
let painter, shown, playing = null;

// ---- numbers out of the page -------------------------------------------------------------------------------------

const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
function values({low, span, data}) {                     // rows of low.length columns, as one Float32Array
  const raw = new DataView(bytes(data).buffer), out = new Float32Array(raw.byteLength / 2), k = low.length;
  for (let i = 0; i < out.length; i++) out[i] = low[i % k] + raw.getUint16(2 * i, true) / STEPS * span[i % k];
  return out;
}
const [quantity, unit] = data.map ?? ["Young's modulus E, logarithmic", "Pa"];
const maps = data.objects.flatMap(o => [o.log_modulus, o.estimate]).filter(Boolean);
const lowest = Math.min(...maps.map(m => m.low[0])), highest = Math.max(...maps.map(m => m.low[0] + m.span[0]));
const number = (x, digits = 3) => x === null ? "–" : Number(x.toPrecision(digits)).toString();
function withUnit(log) {
  const power = Math.max(Math.min(Math.floor(log / 3), 3), 0);
  return `${number(10 ** (log - 3 * power), 2)} ${["", "k", "M", "G"][power]}${unit}`;
}
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

// ---- choices -----------------------------------------------------------------------------------------------------

function tints(column, count) {                          // colours of the cells, or grey
  const log = column && values(column), tint = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const c = log ? mix(VIRIDIS, (log[i] - lowest) / Math.max(highest - lowest, 1e-6)) : BARE;
    for (let n = 0; n < 3; n++) tint[3 * i + n] = c[n] / 255;
  }
  return tint;
}

function chooseObject(k) {
  state.object = (k + data.objects.length) % data.objects.length;
  const o = data.objects[state.object], rest = values(o.points), cells = new Uint32Array(bytes(o.cells).buffer);
  const count = cells.length / o.corners, low = o.points.low, high = low.map((v, n) => v + o.points.span[n]);
  const body = {cells, corners: o.corners, surface: boundary(cells, o.corners, rest.length / 3)};
  shown = {o, body, rest, low, high, middle: low.map((v, n) => 0.5 * (v + high[n])),
           reach: 0.5 * Math.hypot(...o.points.span), tint: tints(o.log_modulus, count),
           estimate: o.estimate && tints(o.estimate, count), frames: o.frames && o.frames.map(values),
           pushed: o.pressure && values(o.pressure).map(p => p / o.pressure.span[0])};
  Object.assign(state, {axis: o.open.axis, cut: o.open.at === null ? 1
    : (o.open.at - low[o.open.axis]) / o.points.span[o.open.axis]});  // opens cut through what is hidden
  $("object").value = state.object;
  $("about").textContent = o.about;
  $("touching").hidden = !o.touches.length;
  $("touch").replaceChildren(...o.touches.map((t, n) => new Option(`${t.number ?? n}${t.touched ? "" : ", no contact"}`, n)));
  $("pictures").hidden = !o.picture;
  if (o.picture) showPictures(o.picture);
  $("legend").hidden = !o.log_modulus && !o.touches.length;
  chooseTouch(0);
}

function chooseTouch(k) {
  const all = shown.o.touches;
  if (all.length) {
    state.touch = (k + all.length) % all.length;
    const size = all[state.touch].normal_force.map(f => Math.abs(f ?? 0));
    state.frame = size.indexOf(Math.max(...size));
    $("touch").value = state.touch;
    $("frame").max = size.length - 1;
  }
  draw();
}

function chooseFrame(k) {
  const touch = shown.o.touches[state.touch];
  if (!touch) return;
  state.frame = (k + touch.force.length) % touch.force.length;
  draw();
}

function play() {
  if (playing) clearInterval(playing);
  playing = playing ? null : setInterval(() => chooseFrame(state.frame + 1), 350);
  $("play").textContent = playing ? "Stop" : "Play";
}

// ---- camera ------------------------------------------------------------------------------------------------------

function camera() {
  const [cy, sy, cp, sp] = [Math.cos(state.yaw), Math.sin(state.yaw), Math.cos(state.pitch), Math.sin(state.pitch)];
  const {width, height} = $("body");
  const fit = 0.44 * Math.min(width / (shown.estimate ? 2 : 1), height * 1.2) / shown.reach;
  return {turn: [[-sy, cy, 0], [-sp * cy, -sp * sy, cp], [cp * cy, cp * sy, sp]], middle: shown.middle,
          scale: fit * state.zoom,                        // of a pair, of the truth in the left half
          shift: state.shift.map((v, n) => v * devicePixelRatio - (shown.estimate && !n ? width / 4 : 0))};
}
function pixel(view, p) {                                // of a point, from the top left of the canvas, and its depth
  const q = view.turn.map(row => row.reduce((sum, v, n) => sum + v * (p[n] - view.middle[n]), 0));
  const {width, height} = $("body");
  return [0.5 * width + q[0] * view.scale + view.shift[0], 0.5 * height - q[1] * view.scale - view.shift[1], q[2]];
}

// ---- drawing -----------------------------------------------------------------------------------------------------

function fitted(canvas) {                                // its pixels are those of the screen
  const width = Math.round(canvas.clientWidth * devicePixelRatio);
  const height = Math.round(canvas.clientHeight * devicePixelRatio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  const pen = canvas.getContext("2d");
  if (pen) { pen.clearRect(0, 0, width, height); pen.lineWidth = 1.5 * devicePixelRatio; }
  return pen;
}
function line(pen, points, style, width) {
  pen.strokeStyle = style;
  pen.lineWidth = width * devicePixelRatio;
  pen.beginPath();
  points.forEach((p, k) => k ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1]));
  pen.stroke();
}
function arrow(pen, from, to, style, width) {
  const angle = Math.atan2(to[1] - from[1], to[0] - from[0]), size = (4 + 2 * width) * devicePixelRatio;
  const wing = side => [to[0] - size * Math.cos(angle + side), to[1] - size * Math.sin(angle + side)];
  line(pen, [from, to], style, width);
  line(pen, [wing(0.45), to, wing(-0.45)], style, width);
}
const along = (p, direction, length) => p.map((v, n) => v + length * direction[n]);

function draw() {
  fitted($("body"));
  const {low, high, reach, o} = shown, view = camera(), pen = fitted($("marks")), a = state.axis;
  const place = low[a] + state.cut * (high[a] - low[a]), {width, height} = $("body");
  const cutting = state.cut < 1 ? {axis: a, place} : null, at = shown.frames ? shown.frames[state.frame] : shown.rest;
  const now = `${a} ${state.cut} ${state.frame}`;
  if (shown.now !== now) {                                // turning needs no new triangles
    shown.now = now;
    const nodes = at.length / 3, push = shown.pushed?.subarray(state.frame * nodes, (state.frame + 1) * nodes);
    shown.parts = [shown.tint, shown.estimate].map(tint => tint && drawn(shown.body, shown.rest, at, tint, cutting, push));
  }
  if (shown.estimate) {                                  // the truth left, the estimate right, turned together
    const half = Math.floor(width / 2), d = devicePixelRatio, [right, up] = view.shift;
    painter.draw(shown.parts[1], {...view, shift: [right + width / 2, up]}, reach, {left: half, width: width - half});
    painter.draw(shown.parts[0], view, reach, {left: 0, width: half});
    line(pen, [[half, 0], [half, height]], colour("line"), 1);
    pen.fillStyle = colour("front");
    pen.font = `${13 * d}px system-ui`;
    pen.textAlign = "right";
    pen.fillText("true", half - 12 * d, 20 * d);
    pen.textAlign = "left";
    pen.fillText("estimated", half + 12 * d, 20 * d);
  } else painter.draw(shown.parts[0], view, reach, {left: 0, width});
  $("cut-at").textContent = state.cut < 1 ? `${"xyz"[a]} ≤ ${(1e3 * place).toFixed(1)} mm` : "whole";
  $("cut").value = 1000 * state.cut;
  $("axis").selectedIndex = a;
  o.touches.forEach((touch, k) => {
    const chosen = k === state.touch, away = view.turn[2].reduce((sum, v, n) => sum + v * touch.axis[n], 0) > 0.2;
    pen.globalAlpha = chosen ? 1 : away ? 0.2 : 0.75;    // those of the far side are fainter
    pen.setLineDash(touch.touched ? [] : [4, 4]);
    arrow(pen, pixel(view, along(touch.target, touch.axis, -0.16 * reach)), pixel(view, touch.target),
          colour(chosen ? "chosen" : "touch"), chosen ? 2.5 : 1.5);
  });
  pen.globalAlpha = 1;
  pen.setLineDash([]);
  const touch = o.touches[state.touch];
  if (touch) { drawFrame(pen, view, touch); drawTargets(); }
  axes(pen, view);
}

function drawFrame(pen, view, touch) {
  const k = state.frame, at = touch.place[k], force = touch.force[k], good = touch.converged[k];
  const most = Math.max(1e-9, ...touch.force.flat().map(f => Math.abs(f ?? 0)));
  if (touch.probe_radius) {                            // a ball is a circle from everywhere
    const [x, y] = pixel(view, at);
    pen.strokeStyle = colour("chosen");
    pen.lineWidth = 1.5 * devicePixelRatio;
    pen.beginPath();
    pen.arc(x, y, touch.probe_radius * view.scale, 0, 7);
    pen.stroke();
  }
  if (touch.skin) drawSkin(pen, view, touch.skin, k);
  if (force.every(f => f !== null) && Math.hypot(...force) > 1e-6) {
    arrow(pen, pixel(view, at), pixel(view, along(at, force, 0.4 * shown.reach / most)), colour("push"), 3);
  }
  $("frame").value = k;
  const pressure = touch.pressure ? `, pressure change ${number(touch.pressure[k])} Pa` : "";
  $("reading").textContent = `frame ${k}: travel ${number(1e3 * touch.travel[k])} mm, normal force ` +
    `${number(touch.normal_force[k])} N${pressure}${good ? "" : ", NOT CONVERGED"}`;
  $("reading").style.color = good ? "" : colour("bad");
  curve($("force"), "normal force [N]", t => t.normal_force);
  $("pressure").hidden = !touch.pressure;
  if (touch.pressure) curve($("pressure"), "pressure change [Pa]", t => t.pressure);
}

function drawSkin(pen, view, skin, frame) {              // nodes of the bubble as dots, forces on them as lines
  skin.read ??= {place: values(skin.position), force: values(skin.force)};
  const {place, force} = skin.read, row = n => 3 * (frame * skin.nodes + n), d = devicePixelRatio;
  const size = n => Math.hypot(...force.subarray(row(n), row(n) + 3));
  let most = 1e-9;
  for (let n = 0; n < skin.nodes; n++) most = Math.max(most, size(n));
  pen.fillStyle = colour("chosen");
  for (let n = 0; n < skin.nodes; n++) {
    const p = [...place.subarray(row(n), row(n) + 3)], [x, y] = pixel(view, p);
    pen.fillRect(x - d, y - d, 2 * d, 2 * d);
    if (size(n) > 0.02 * most) {
      const to = along(p, force.subarray(row(n), row(n) + 3), 0.15 * shown.reach / most);
      line(pen, [[x, y], pixel(view, to)], colour("push"), 1);
    }
  }
}

function axes(pen, view) {
  const d = devicePixelRatio, root = [$("marks").width - 50 * d, 50 * d];
  pen.fillStyle = colour("front");
  pen.font = `${12 * d}px system-ui`;
  [0, 1, 2].forEach(n => {
    const to = [root[0] + 30 * d * view.turn[0][n], root[1] - 30 * d * view.turn[1][n]];
    arrow(pen, root, to, colour("faint"), 1);
    pen.fillText("xyz"[n], to[0] + 4 * d, to[1] - 4 * d);
  });
  const length = 10 ** Math.floor(Math.log10(150 * d / view.scale)), wide = length * view.scale;
  const y = 100 * d, x = $("marks").width - 15 * d;
  line(pen, [[x - wide, y], [x, y]], colour("front"), 2);
  pen.textAlign = "right";
  pen.fillText(`${number(1e3 * length)} mm`, x, y + 15 * d);
  pen.textAlign = "left";
}

// ---- mouse, fingers and keys -------------------------------------------------------------------------------------

const RESET = {yaw: state.yaw, pitch: state.pitch, zoom: 1, shift: [0, 0]};
const fingers = new Map();
let moved = 0;

function turn(yaw, pitch) {
  state.yaw += yaw;
  state.pitch = Math.min(Math.max(state.pitch + pitch, -1.57), 1.57);
  draw();
}
function zoom(factor) { state.zoom = Math.min(Math.max(state.zoom * factor, 0.2), 20); draw(); }
function cut(by) { state.cut = Math.min(Math.max(state.cut + by, 0), 1); draw(); }

function listen() {
  const stage = $("stage");
  stage.onpointerdown = e => {
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    stage.setPointerCapture(e.pointerId);
    moved = 0;
  };
  stage.onpointerup = stage.onpointercancel = e => {
    fingers.delete(e.pointerId);
    if (e.type === "pointerup" && moved < 4) pick(e);
  };
  stage.onpointermove = e => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const [dx, dy] = [e.clientX - before[0], e.clientY - before[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    const other = [...fingers].find(([id]) => id !== e.pointerId)?.[1];
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (other) {
      const far = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
      state.shift = [state.shift[0] + dx / 2, state.shift[1] - dy / 2];
      zoom(far([e.clientX, e.clientY]) / Math.max(far(before), 1));
    } else if (e.shiftKey || e.buttons === 4) {
      state.shift = [state.shift[0] + dx, state.shift[1] - dy];
      draw();
    } else turn(-0.008 * dx, 0.008 * dy);
  };
  stage.onwheel = e => { e.preventDefault(); zoom(Math.exp(-0.0012 * e.deltaY)); };
  $("object").onchange = e => chooseObject(+e.target.value);
  $("touch").onchange = e => chooseTouch(+e.target.value);
  $("frame").oninput = e => chooseFrame(+e.target.value);
  $("cut").oninput = e => { state.cut = e.target.value / 1000; draw(); };
  $("axis").onchange = e => { state.axis = e.target.selectedIndex; draw(); };
  $("play").onclick = play;
  document.onkeydown = e => {
    if (e.ctrlKey || e.altKey || e.metaKey || ["INPUT", "SELECT"].includes(e.target.tagName)) return;
    const does = {
      ArrowLeft: () => chooseFrame(state.frame - 1), ArrowRight: () => chooseFrame(state.frame + 1),
      ArrowUp: () => chooseTouch(state.touch - 1), ArrowDown: () => chooseTouch(state.touch + 1),
      n: () => chooseObject(state.object + 1), p: () => chooseObject(state.object - 1),
      "[": () => cut(-0.02), "]": () => cut(0.02), a: () => turn(-0.1, 0), d: () => turn(0.1, 0),
      w: () => turn(0, 0.1), s: () => turn(0, -0.1), "+": () => zoom(1.1), "-": () => zoom(1 / 1.1),
      r: () => { Object.assign(state, structuredClone(RESET)); chooseObject(state.object); },
      " ": () => e.target.tagName === "BUTTON" || play(),
    };
    for (const n of [0, 1, 2]) does["xyz"[n]] = () => { state.axis = n; draw(); };
    const act = does[e.key] ?? does[e.key.toLowerCase()];
    if (!act) return;
    if (e.target.tagName !== "BUTTON") e.preventDefault();
    act();
  };
  new ResizeObserver(draw).observe(stage);
  matchMedia("(prefers-color-scheme: dark)").onchange = draw;
}

function pick(e) {                                       // the touch whose target is nearest to a click
  const box = $("body").getBoundingClientRect(), view = camera(), d = devicePixelRatio;
  const far = shown.o.touches.map(t => {
    const [x, y] = pixel(view, t.target);
    return Math.hypot(x - (e.clientX - box.left) * d, y - (e.clientY - box.top) * d);
  });
  const least = Math.min(...far);
  if (least < 30 * d) chooseTouch(far.indexOf(least));
}

// #object=2&touch=3&frame=1&axis=x&cut=0.5 in the address opens the page there
function fromAddress() {
  const asked = new URLSearchParams(location.hash.slice(1)), whole = key => parseInt(asked.get(key), 10);
  if (whole("object") < data.objects.length) chooseObject(whole("object"));
  if (whole("touch") < shown.o.touches.length) chooseTouch(whole("touch"));
  if (whole("frame") >= 0) chooseFrame(whole("frame"));
  if ("xyz".includes(asked.get("axis") ?? "-")) state.axis = "xyz".indexOf(asked.get("axis"));
  if (asked.has("cut")) cut(parseFloat(asked.get("cut")) - state.cut);
}

$("title").textContent = data.title;
$("object").replaceChildren(...data.objects.map((o, k) => new Option(o.name, k)));
try {
  painter = new Painter($("body"));
  legend();
  chooseObject(0);
  fromAddress();
  listen();
} catch (problem) {
  $("about").textContent = problem.message;
  throw problem;
}
