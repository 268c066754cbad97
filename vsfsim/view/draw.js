"use strict";
// Balls of one colour each, drawn by WebGL 2 from a parallel camera and cut by a plane.
//
// A ball is one point of the size of the ball; its fragments find where the line of sight meets the ball. Where the
// plane has cut that place away they find where it meets the plane, and the centre that is nearest there wins, so that
// the cut face shows the cells around the centres.

const VIRIDIS = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b",
  "#fde725"];

const VERTEX = `#version 300 es
in vec3 place; in float radius; in vec3 colour;
uniform mat3 turn; uniform vec3 middle; uniform vec2 shift, size; uniform float scale;
out vec3 seen, tint; out float ball;
void main() {
  seen = turn * (place - middle);                       // x right, y up, z towards the eye [m]
  ball = radius; tint = colour;
  gl_Position = vec4((seen.xy * scale + shift) / (0.5 * size), 0.0, 1.0);
  gl_PointSize = 2.0 * radius * scale + 1.0;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen, tint; in float ball;
uniform float scale, reach; uniform vec4 plane;          // keeps where dot(plane.xyz, p) <= plane.w, in the eye's axes
out vec4 result;
void main() {
  vec2 off = (gl_PointCoord - 0.5) * vec2(1.0, -1.0) * (2.0 * ball * scale + 1.0) / scale;
  float high2 = ball * ball - dot(off, off);
  if (high2 < 0.0) discard;
  float high = sqrt(high2);
  vec3 normal = vec3(off, high) / ball, at = seen + vec3(off, high);
  float bias = 0.0;
  if (dot(plane.xyz, at) > plane.w) {                    // cut away: the line of sight goes on to the plane
    if (plane.z < 1e-4) discard;
    at.z = (plane.w - dot(plane.xy, at.xy)) / plane.z;
    vec3 from = at - seen;
    if (dot(from, from) > ball * ball) discard;
    normal = plane.xyz;
    bias = dot(from, from) / reach * 0.02;               // the nearest centre wins on the face of the cut
  }
  float light = 0.35 + 0.65 * max(dot(normal, normalize(vec3(0.3, 0.5, 0.8))), 0.0);
  gl_FragDepth = clamp(0.5 - 0.5 * (at.z - bias) / reach, 0.0, 1.0);
  result = vec4(tint * light, 1.0);
}`;

function mix(stops, t) {
  const x = Math.min(Math.max(t, 0), 1) * (stops.length - 1), k = Math.min(Math.floor(x), stops.length - 2);
  const part = (hex, n) => parseInt(hex.slice(1 + 2 * n, 3 + 2 * n), 16);
  return [0, 1, 2].map(n => part(stops[k], n) + (x - k) * (part(stops[k + 1], n) - part(stops[k], n)));
}

class Balls {
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
    this.buffers = ["place", "radius", "colour"].map(name => [gl.getAttribLocation(program, name), gl.createBuffer()]);
    this.count = 0;
  }

  // place (3 n), radius (n) in metres, colour (3 n) from 0 to 1
  load(place, radius, colour) { this.put([place, radius, colour]); this.count = radius.length; }
  tint(colour) { this.put([null, null, colour]); }

  put(columns) {
    const gl = this.gl;
    columns.forEach((values, k) => {
      if (!values) return;
      const [where, buffer] = this.buffers[k];
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, k === 1 ? 1 : 3, gl.FLOAT, false, 0, 0);
    });
  }

  // camera: turn (rows: right, up, towards the eye), middle, scale [px/m], shift [px]; reach [m] bounds the depth;
  // cut: axis number and place in the world, or null; pane: left edge and width of the part of the
  // canvas that is drawn [px]
  draw(camera, reach, cut, pane) {
    const gl = this.gl, {turn, middle, scale, shift} = camera, {width, height} = gl.canvas;
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
    const normal = cut ? turn.map(row => row[cut.axis]) : [0, 0, 1];
    gl.uniform4f(this.at("plane"), ...normal, cut ? cut.place - middle[cut.axis] : 1e9);
    gl.drawArrays(gl.POINTS, 0, this.count);
  }
}
