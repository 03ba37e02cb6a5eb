// Draws a motion given by modes: position = rest + shift(t) + sum_k amplitude_k(t) mode_k. Lengths are in mm, z is up.
const byId = (id) => document.getElementById(id);
const vertexShader = `#version 300 es
in vec3 position, normal, rest;
uniform mat4 camera;
uniform vec4 flatten; // of a shadow: direction of the sun over its height, and the height of the ground
uniform bool shadow;
out vec3 n, at, home;
void main() {
  at = shadow ? vec3(position.xy - flatten.xy * (position.z - flatten.w), flatten.w + 0.02) : position;
  n = normal; home = rest;
  gl_Position = camera * vec4(at, 1.0);
}`;
const fragmentShader = `#version 300 es
precision highp float;
in vec3 n, at, home;
uniform vec3 front, back, eye, light;
uniform vec4 cut; // normal and place of the plane that takes away, in the undeformed body
uniform float alpha;
uniform bool lit, shadow;
out vec4 color;
vec4 hatched(vec3 tint) {
  float line = smoothstep(0.0, 1.5, abs(mod(gl_FragCoord.x + gl_FragCoord.y, 11.0) - 5.5));
  return vec4(tint * (0.86 + 0.14 * line), 1.0);
}
void main() {
  if (dot(cut.xyz, home) > cut.w) discard;
  if (shadow) { color = vec4(0.32, 0.36, 0.42, 1.0); return; }
  // The back of a closed surface is seen only through the cut: it fills the area of the section.
  if (!gl_FrontFacing) { color = hatched(back); return; }
  if (!lit) { color = hatched(front); return; }
  vec3 m = normalize(n), view = normalize(eye - at);
  if (dot(m, view) < 0.0 && alpha == 1.0) m = -m; // the chamber, seen from outside of it
  float lambert = max(dot(m, light), 0.0), sky = 0.5 + 0.5 * m.z;
  float gloss = 0.16 * pow(max(dot(m, normalize(light + view)), 0.0), 28.0);
  float rim = 0.10 * pow(1.0 - max(dot(m, view), 0.0), 3.0);
  color = vec4(front * (0.40 + 0.22 * sky + 0.50 * lambert) + gloss + rim, alpha);
}`;
const planeVertex = `#version 300 es
in vec3 position;
uniform mat4 camera;
out vec3 at;
void main() { at = position; gl_Position = camera * vec4(position, 1.0); }`;
const planeFragment = `#version 300 es
precision highp float;
in vec3 at;
uniform vec3 color;
uniform int axis;
uniform float alpha;
out vec4 result;
float lines(vec2 p, float every, float width) {
  vec2 scale = fwidth(p), d = abs(fract(p / every - 0.5) - 0.5) * every;
  vec2 on = 1.0 - smoothstep(width * scale * 0.5, width * scale * 0.5 + scale, d);
  return max(on.x, on.y);
}
void main() {
  vec2 p = axis == 2 ? at.xy : (axis == 0 ? at.yz : at.xz);
  float line = max(0.3 * lines(p, 5.0, 0.3), 0.65 * lines(p, 10.0, 0.6));
  result = vec4(mix(color, vec3(0.62, 0.67, 0.73), line), mix(alpha, 1.0, 0.6 * line * (1.0 - alpha)));
}`;

const state = { time: 0, playing: false, azimuth: -62, elevation: 18, distance: 2.3, pan: [0, -4], dirty: true };
let gl, body, planes, data, clock = null;

function fail(text) { byId("stage").textContent = text; throw new Error(text); }

async function unpack() {
  const bytes = Uint8Array.from(atob(packed), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const count = about.vertices, whole = (offset, length) => new Int32Array(buffer, 4 * offset, length);
  const faces = whole(0, 3 * about.faces);
  const running = (values) => { // stored as differences from one vertex to the next, component by component
    const found = new Float32Array(3 * count);
    for (let axis = 0; axis < 3; axis++)
      for (let i = 0, sum = 0; i < count; i++) { sum += values[axis * count + i]; found[3 * i + axis] = sum * about.step; }
    return found;
  };
  const rest = running(whole(3 * about.faces, 3 * count)), modes = [];
  for (let k = 0; k < about.modes; k++) modes.push(running(whole(3 * about.faces + 3 * count * (k + 1), 3 * count)));
  const index = new Uint32Array(3 * about.faces);
  for (let i = 0, sum = 0; i < index.length; i++) { sum += faces[i]; index[i] = sum; }
  return { rest, modes, index, position: new Float32Array(3 * count), normal: new Float32Array(3 * count) };
}

function between(time) { // the samples around a time, and the part of the way from the first to the second
  const t = about.time;
  let low = 0, high = t.length - 1;
  while (high - low > 1) { const mid = (low + high) >> 1; if (t[mid] <= time) low = mid; else high = mid; }
  const part = high > low ? Math.min(Math.max((time - t[low]) / (t[high] - t[low]), 0), 1) : 0;
  return (values) => values[low] + part * (values[high] - values[low]);
}

function place(time) {
  const value = between(time), { rest, modes, index, position, normal } = data;
  const shift = about.shift.map(value);
  for (let i = 0; i < position.length; i++) position[i] = rest[i] + shift[i % 3];
  modes.forEach((mode, k) => {
    const a = value(about.amplitude[k]);
    for (let i = 0; i < position.length; i++) position[i] += a * mode[i];
  });
  normal.fill(0);
  for (let f = 0; f < index.length; f += 3) {
    const a = 3 * index[f], b = 3 * index[f + 1], c = 3 * index[f + 2];
    const ux = position[b] - position[a], uy = position[b + 1] - position[a + 1], uz = position[b + 2] - position[a + 2];
    const vx = position[c] - position[a], vy = position[c + 1] - position[a + 1], vz = position[c + 2] - position[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const i of [a, b, c]) { normal[i] += x; normal[i + 1] += y; normal[i + 2] += z; }
  }
  return { center: about.center.map(value), travel: value(about.travel), pressure: value(about.pressure) };
}

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) fail(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) fail(gl.getProgramInfoLog(made));
  const uniform = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name;
    uniform[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniform };
}

function attribute(shader, name, values, usage) {
  const buffer = gl.createBuffer(), where = gl.getAttribLocation(shader.made, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, values, usage);
  gl.enableVertexAttribArray(where);
  gl.vertexAttribPointer(where, 3, gl.FLOAT, false, 0, 0);
  return buffer;
}

function start() {
  gl = byId("view").getContext("webgl2", { antialias: true, stencil: true, preserveDrawingBuffer: true });
  if (!gl) fail("This page needs a browser with WebGL 2.");
  body = program(vertexShader, fragmentShader);
  body.array = gl.createVertexArray(); gl.bindVertexArray(body.array);
  body.position = attribute(body, "position", data.position, gl.DYNAMIC_DRAW);
  body.normal = attribute(body, "normal", data.normal, gl.DYNAMIC_DRAW);
  attribute(body, "rest", data.rest, gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, data.index, gl.STATIC_DRAW);
  planes = program(planeVertex, planeFragment);
  planes.array = gl.createVertexArray(); gl.bindVertexArray(planes.array);
  attribute(planes, "position", new Float32Array(about.planes.flatMap((p) => p.corners.flat())), gl.STATIC_DRAW);
  for (const tick of about.ticks) {
    tick.label = document.createElement("span");
    tick.label.className = "tick"; tick.label.textContent = tick.text;
    byId("stage").append(tick.label);
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
function look(center, aspect) {
  const a = state.azimuth * Math.PI / 180, e = state.elevation * Math.PI / 180;
  const right = [-Math.sin(a), Math.cos(a), 0];
  const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
  const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  const far = state.distance * about.extent * Math.max(1, 1.2 / aspect), f = 1 / Math.tan(Math.PI / 11);
  const eye = center.map((c, i) => c + far * back[i] + state.pan[0] * right[i] + state.pan[1] * up[i]);
  const near = 0.05 * far, end = 20 * far, p = (end + near) / (near - end), q = 2 * end * near / (near - end);
  const rows = [right.map((v) => v * f / aspect), up.map((v) => v * f), back.map((v) => v * p), back.map((v) => -v)];
  const last = [-dot(right, eye) * f / aspect, -dot(up, eye) * f, -dot(back, eye) * p + q, dot(back, eye)];
  const matrix = new Float32Array(16); // column by column
  rows.forEach((row, r) => { row.forEach((v, c) => { matrix[4 * c + r] = v; }); matrix[12 + r] = last[r]; });
  const light = [0, 1, 2].map((i) => -0.45 * right[i] + 0.62 * back[i] + (i === 2 ? 0.75 : 0));
  const length = Math.hypot(...light);
  return { matrix, eye, back, light: light.map((v) => v / length) };
}

function mix(from, to, part) { return from.map((v, i) => v + part * (to[i] - v)); }

function drawPlanes(camera, behind) {
  gl.useProgram(planes.made); gl.bindVertexArray(planes.array);
  gl.uniformMatrix4fv(planes.uniform.camera, false, camera.matrix);
  about.planes.forEach((plane, i) => {
    const seen = (camera.eye[plane.axis] - plane.corners[0][plane.axis]) * plane.side > 0;
    if (seen !== behind) return;
    gl.uniform3fv(planes.uniform.color, plane.axis === 2 ? [0.93, 0.945, 0.96] : [0.84, 0.885, 0.925]);
    gl.uniform1i(planes.uniform.axis, plane.axis);
    gl.uniform1f(planes.uniform.alpha, behind ? 1 : 0.15);
    gl.drawArrays(gl.TRIANGLE_STRIP, 4 * i, 4);
  });
}

function draw() {
  const canvas = byId("view"), ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const now = place(state.time);
  const center = byId("follow").checked ? now.center : about.middle;
  const camera = look(center, width / Math.max(height, 1));
  gl.viewport(0, 0, width, height);
  gl.clearColor(1, 1, 1, 1); gl.clearStencil(0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
  drawPlanes(camera, true);

  gl.useProgram(body.made); gl.bindVertexArray(body.array);
  for (const name of ["position", "normal"]) {
    gl.bindBuffer(gl.ARRAY_BUFFER, body[name]); gl.bufferSubData(gl.ARRAY_BUFFER, 0, data[name]);
  }
  const u = body.uniform, axis = byId("axis").value, other = byId("flip").checked ? -1 : 1;
  const cut = [0, 0, 0, 1e9];
  if (axis !== "") {
    const [low, high] = [about.low[axis], about.high[axis]], at = low + Number(byId("cut").value) * (high - low);
    // What is nearer to the usual view is taken away: smaller x and z are kept, larger y.
    const side = other * (axis === "1" ? -1 : 1);
    cut[axis] = side; cut[3] = side * at;
    byId("at").textContent = `${at.toFixed(1)} mm`;
  } else byId("at").textContent = "";
  gl.uniformMatrix4fv(u.camera, false, camera.matrix);
  gl.uniform3fv(u.eye, camera.eye); gl.uniform3fv(u.light, camera.light); gl.uniform4fv(u.cut, cut);
  const ground = about.planes.find((p) => p.axis === 2 && p.side > 0);
  if (ground) { // each pixel of the shadow once
    gl.uniform1i(u.shadow, 1);
    gl.uniform4fv(u.flatten, [camera.light[0] / 1.4, camera.light[1] / 1.4, 0, ground.corners[0][2]]);
    gl.enable(gl.STENCIL_TEST); gl.stencilFunc(gl.EQUAL, 0, 255); gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.blendColor(0, 0, 0, 0.26); gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA); gl.depthMask(false);
    const outer = about.parts.filter((p) => p.outer);
    for (const part of outer) gl.drawElements(gl.TRIANGLES, 3 * part.count, gl.UNSIGNED_INT, 12 * part.start);
    gl.depthMask(true); gl.disable(gl.STENCIL_TEST); gl.uniform1i(u.shadow, 0);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
  }
  const fill = Math.min(Math.max(now.pressure / Math.max(...about.pressure, 1e-9), 0), 1), through = byId("through").checked;
  const drawPart = (part) => {
    const front = part.name === "cavity" ? mix(about.colors.rest, about.colors.full, fill) : part.front;
    gl.uniform3fv(u.front, front); gl.uniform3fv(u.back, part.back); gl.uniform1i(u.lit, part.lit);
    gl.drawElements(gl.TRIANGLES, 3 * part.count, gl.UNSIGNED_INT, 12 * part.start);
  };
  gl.uniform1f(u.alpha, 1);
  gl.frontFace(gl.CCW);
  for (const part of about.parts.filter((p) => !p.outer)) {
    if (axis === "" && !(through && part.name === "cavity")) continue;
    // The front of the cavity's faces is towards the air; seen through the body, their other side is shown.
    if (part.name === "cavity" && axis === "") { gl.frontFace(gl.CW); drawPart(part); gl.frontFace(gl.CCW); } else drawPart(part);
  }
  if (through) gl.uniform1f(u.alpha, 0.4);
  if (through && axis === "") { gl.enable(gl.CULL_FACE); gl.cullFace(gl.BACK); }
  about.parts.filter((p) => p.outer).forEach(drawPart);
  gl.disable(gl.CULL_FACE);
  gl.depthMask(false); drawPlanes(camera, false); gl.depthMask(true);
  for (const tick of about.ticks) {
    const m = camera.matrix, p = tick.at, w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
    const x = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w, y = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
    tick.label.style.transform = `translate(${(0.5 + 0.5 * x) * canvas.clientWidth}px, ${(0.5 - 0.5 * y) * canvas.clientHeight}px) translate(-50%, 2px)`;
    tick.label.hidden = w <= 0;
  }
  byId("state").textContent = `t = ${(1e3 * (state.time - about.time[0])).toFixed(0)} ms   travel ${now.travel.toFixed(2)} mm   pressure ${(now.pressure).toFixed(1)} kPa`;
  byId("time").value = 1000 * (state.time - about.time[0]) / (about.time[about.time.length - 1] - about.time[0]);
  drawTrace(now.pressure);
}

function drawTrace(pressure) {
  const canvas = byId("trace"), ratio = window.devicePixelRatio || 1, c = canvas.getContext("2d");
  const width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio; c.scale(ratio, ratio);
  const t = about.time, first = t[0], last = t[t.length - 1], top = 1.15 * Math.max(...about.pressure, 1e-9);
  const x = (v) => 58 + (width - 74) * (v - first) / (last - first), y = (v) => height - 16 - (height - 24) * v / top;
  c.font = "12px system-ui, sans-serif"; c.fillStyle = "#6b7683";
  c.fillText("kPa", 8, 14); c.fillText((top / 1.15).toFixed(0), 8, y(top / 1.15) + 12);
  c.strokeStyle = "#e1e6eb"; c.beginPath(); c.moveTo(x(first), y(0)); c.lineTo(x(last), y(0)); c.stroke();
  const path = () => { c.beginPath(); t.forEach((v, i) => c.lineTo(x(v), y(about.pressure[i]))); };
  path(); c.lineTo(x(last), y(0)); c.lineTo(x(first), y(0)); c.closePath(); c.fillStyle = "#f1e8ef"; c.fill();
  path(); c.strokeStyle = "#9a4f78"; c.lineWidth = 2; c.stroke();
  c.strokeStyle = "#27313d"; c.lineWidth = 1; c.beginPath(); c.moveTo(x(state.time), 6); c.lineTo(x(state.time), height - 12); c.stroke();
  c.beginPath(); c.arc(x(state.time), y(pressure), 4.5, 0, 7); c.fillStyle = "#fff"; c.fill(); c.lineWidth = 2; c.stroke();
}

function tick(stamp) {
  if (state.playing) {
    const first = about.time[0], length = about.time[about.time.length - 1] - first;
    if (clock !== null) state.time = first + (state.time - first + (stamp - clock) / 1e3 * Number(byId("speed").value)) % length;
    state.dirty = true;
  }
  clock = stamp;
  if (state.dirty) { state.dirty = false; draw(); }
  requestAnimationFrame(tick);
}

function controls() {
  const first = about.time[0], length = about.time[about.time.length - 1] - first;
  const play = (on) => { state.playing = on; byId("play").textContent = on ? "Pause" : "Play"; };
  const to = (part) => { play(false); state.time = first + Math.min(Math.max(part, 0), 1) * length; state.dirty = true; };
  byId("play").onclick = () => play(!state.playing);
  byId("time").oninput = (e) => to(e.target.value / 1000);
  byId("trace").onpointerdown = (e) => to((e.offsetX - 58) / (byId("trace").clientWidth - 74));
  for (const id of ["axis", "cut", "flip", "follow", "through"]) byId(id).addEventListener("input", () => { state.dirty = true; });
  for (const button of document.querySelectorAll("[data-view]")) button.onclick = () => {
    [state.azimuth, state.elevation] = button.dataset.view.split(",").map(Number);
    state.pan = [0, -4]; state.dirty = true;
  };
  const view = byId("view");
  view.onpointerdown = (e) => view.setPointerCapture(e.pointerId);
  view.onpointermove = (e) => {
    if (!e.buttons) return;
    if (e.shiftKey || e.buttons === 2) {
      const scale = state.distance * about.extent / view.clientHeight * 0.6;
      state.pan[0] -= e.movementX * scale; state.pan[1] += e.movementY * scale;
    } else {
      state.azimuth -= 0.4 * e.movementX;
      state.elevation = Math.min(Math.max(state.elevation + 0.4 * e.movementY, -89), 89);
    }
    state.dirty = true;
  };
  view.oncontextmenu = (e) => e.preventDefault();
  view.addEventListener("wheel", (e) => {
    e.preventDefault(); state.distance = Math.min(Math.max(state.distance * Math.exp(0.001 * e.deltaY), 0.6), 12); state.dirty = true;
  }, { passive: false });
  new ResizeObserver(() => { state.dirty = true; }).observe(byId("stage"));
  // The address can say what to show: motion.html#time=0.1&axis=1&view=-90,4
  const asked = new URLSearchParams(location.hash.slice(1));
  for (const id of ["axis", "cut", "speed"]) if (asked.has(id)) byId(id).value = asked.get(id);
  for (const id of ["flip", "follow", "through"]) if (asked.has(id)) byId(id).checked = asked.get(id) === "1";
  if (asked.has("view")) [state.azimuth, state.elevation] = asked.get("view").split(",").map(Number);
  play(true);
  if (asked.has("time")) to(Number(asked.get("time")) / length);
}

unpack().then((found) => {
  data = found; state.time = about.time[0];
  start(); controls(); requestAnimationFrame(tick);
  document.body.dataset.ready = "1";
});
