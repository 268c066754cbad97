"use strict";
// A body of tetrahedra, or a surface of triangles, of one colour each, drawn by WebGL 2 from a parallel camera and cut
// by a plane: what lies beyond it at rest is left out, and the face of the cut shows the tetrahedra that it passes.

const VIRIDIS = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b",
  "#fde725"];
const PRESSED = "#d7191c";                               // no colour of the map is like it

const VERTEX = `#version 300 es
in vec3 place, colour, edge; in float away;
uniform mat3 turn; uniform vec3 middle; uniform vec2 shift, size; uniform float scale, reach;
out vec3 seen, tint, border; out float beyond;
void main() {
  seen = turn * (place - middle);                       // x right, y up, z towards the eye [m]
  tint = colour; border = edge; beyond = away;
  gl_Position = vec4((seen.xy * scale + shift) / (0.5 * size), -seen.z / (2.0 * reach), 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen, tint, border; in float beyond;
out vec4 result;
void main() {
  if (beyond > 0.0) discard;
  vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
  float light = 0.45 + 0.55 * max(dot(normal * sign(normal.z), normalize(vec3(0.3, 0.5, 0.8))), 0.0);
  vec3 near = border / max(fwidth(border), 1e-6);
  float line = 1.0 - smoothstep(0.2, 0.9, min(near.x, min(near.y, near.z)));
  result = vec4(mix(tint * light, vec3(0.8), 0.3 * line), 1.0);
}`;

const part = (hex, n) => parseInt(hex.slice(1 + 2 * n, 3 + 2 * n), 16);
function mix(stops, t) {
  const x = Math.min(Math.max(t, 0), 1) * (stops.length - 1), k = Math.min(Math.floor(x), stops.length - 2);
  return [0, 1, 2].map(n => part(stops[k], n) + (x - k) * (part(stops[k + 1], n) - part(stops[k], n)));
}

// Triangles of the surface of cells of 3 or 4 nodes, and the cell of each. Of tetrahedra those that belong to one alone.
function boundary(cells, corners, nodes) {
  if (corners === 3) return {triangles: cells, owner: Uint32Array.from({length: cells.length / 3}, (_, i) => i)};
  const found = new Map();
  for (let c = 0; c < cells.length / 4; c++) for (const [i, j, k] of [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]) {
    const face = [cells[4 * c + i], cells[4 * c + j], cells[4 * c + k]], [a, b, d] = [...face].sort((x, y) => x - y);
    const key = (a * nodes + b) * nodes + d;
    if (!found.delete(key)) found.set(key, [face, c]);
  }
  const all = [...found.values()];
  return {triangles: Uint32Array.from(all.flatMap(one => one[0])), owner: Uint32Array.from(all.map(one => one[1]))};
}

// What is drawn: corners of triangles with their place, how far beyond the plane they are at rest, colour and borders.
// body: cells, corners, surface; rest and at: nodes (3 n) [m]; tint: (3 a cell); cut: axis and place, or null; push: how
// far the surface has the colour of a pressure (n, 0 to 1), or null
function drawn({cells, corners, surface}, rest, at, tint, cut, push) {
  const out = {place: [], away: [], colour: [], edge: []}, inner = [0, 1, 2];
  const far = node => cut ? rest[3 * node + cut.axis] - cut.place : -1;
  const pressed = inner.map(n => part(PRESSED, n) / 255);
  const add = (places, away, cell, edges, pushed = [0, 0, 0]) => places.forEach((p, k) => {
    out.place.push(...p);
    out.away.push(away[k]);
    for (const n of inner) {
      out.colour.push(tint[3 * cell + n] + pushed[k] * (pressed[n] - tint[3 * cell + n]));
      out.edge.push(n === k || !edges[n] ? 1 : 0);
    }
  });
  const point = node => [at[3 * node], at[3 * node + 1], at[3 * node + 2]];
  const lined = corners === 4 ? [1, 1, 1] : [0, 0, 0];
  surface.owner.forEach((cell, f) => {
    const nodes = inner.map(k => surface.triangles[3 * f + k]), away = nodes.map(far);
    if (Math.min(...away) <= 0) add(nodes.map(point), away, cell, lined, nodes.map(n => push ? push[n] : 0));
  });
  if (cut && corners === 4) for (let c = 0; c < cells.length / 4; c++) {
    const nodes = [0, 1, 2, 3].map(k => cells[4 * c + k]);
    const kept = nodes.filter(n => far(n) <= 0), off = nodes.filter(n => far(n) > 0);
    if (!kept.length || !off.length) continue;
    const on = (a, b) => {
      const t = far(a) / (far(a) - far(b)), q = point(b);
      return point(a).map((v, n) => v + t * (q[n] - v));
    };
    const round = kept.length === 2 ? [on(kept[0], off[0]), on(kept[0], off[1]), on(kept[1], off[1]), on(kept[1], off[0])]
      : kept.flatMap(a => off.map(b => on(a, b)));
    for (let k = 2; k < round.length; k++) {               // the border between the two halves of a quadrangle is none
      add([round[0], round[k - 1], round[k]], [-1, -1, -1], c, [1, k === round.length - 1 ? 1 : 0, k === 2 ? 1 : 0]);
    }
  }
  return Object.fromEntries(Object.entries(out).map(([name, numbers]) => [name, new Float32Array(numbers)]));
}

class Painter {
  constructor(canvas) {
    const gl = this.gl = canvas.getContext("webgl2", {antialias: true, alpha: true, preserveDrawingBuffer: true});
    if (!gl) throw new Error("This browser has no WebGL 2, which draws the object.");
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    this.at = name => gl.getUniformLocation(program, name);
    this.buffers = ["place", "away", "colour", "edge"].map(name => [name, gl.getAttribLocation(program, name),
                                                                      gl.createBuffer()]);
  }

  // corners: of `drawn`; camera: turn (rows: right, up, towards the eye), middle, scale [px/m], shift [px]; reach [m]
  // bounds the depth; pane: left edge and width of the part of the canvas that is drawn [px]
  draw(corners, camera, reach, pane) {
    const gl = this.gl, {turn, middle, scale, shift} = camera, {width, height} = gl.canvas;
    for (const [name, where, buffer] of this.buffers) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, corners[name], gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, name === "away" ? 1 : 3, gl.FLOAT, false, 0, 0);
    }
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(pane.left, 0, pane.width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(this.at("turn"), true, turn.flat());
    gl.uniform3fv(this.at("middle"), middle);
    gl.uniform2fv(this.at("shift"), shift);
    gl.uniform2f(this.at("size"), width, height);
    gl.uniform1f(this.at("scale"), scale);
    gl.uniform1f(this.at("reach"), reach);
    gl.drawArrays(gl.TRIANGLES, 0, corners.away.length);
  }
}
