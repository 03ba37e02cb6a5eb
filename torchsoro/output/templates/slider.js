// Surfaces and dots that move, drawn from behind to the front without perspective. Lengths are in mm, z is up.
async function slider(box, about) {
  const find = (name) => box.querySelector(`[data-part=${name}]`);
  const bytes = Uint8Array.from(atob(about.packed), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const steps = new Int16Array(await new Response(stream).arrayBuffer());
  const frame = 3 * about.count, canvas = find("view"), context = canvas.getContext("2d");
  for (let i = frame; i < steps.length; i++) steps[i] += steps[i - frame]; // stored as differences between frames
  const state = { frame: about.begin, azimuth: about.azimuth, elevation: 12, hidden: new Set(), clock: null };
  const middle = about.low.map((low, k) => (low + about.high[k]) / 2);
  const [wide, deep, tall] = about.low.map((low, k) => about.high[k] - low);
  const flat = Math.hypot(wide, deep), extent = Math.hypot(flat, tall);

  function seen(vertex) { // right, up, towards the viewer [mm]; null where a sample was lost
    const at = state.frame * frame + 3 * vertex;
    if (steps[at] === about.unknown) return null;
    const [x, y, z] = middle.map((m, k) => about.low[k] + about.step * steps[at + k] - m);
    const a = state.azimuth * Math.PI / 180, e = state.elevation * Math.PI / 180;
    const out = x * Math.cos(a) + y * Math.sin(a);
    return [y * Math.cos(a) - x * Math.sin(a), z * Math.cos(e) - out * Math.sin(e), out * Math.cos(e) + z * Math.sin(e)];
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    const e = Math.abs(state.elevation) * Math.PI / 180;
    const scale = 0.9 * ratio * Math.min(width / flat, height / (tall * Math.cos(e) + flat * Math.sin(e)));
    const place = (p) => [canvas.width / 2 + scale * p[0], canvas.height / 2 - scale * p[1]];
    const things = [];
    about.parts.forEach((part, number) => {
      if (state.hidden.has(number)) return;
      const points = Array.from({ length: part.count }, (_, k) => seen(part.start + k));
      if (part.faces) for (const face of part.faces) {
        const corners = face.map((k) => points[k]);
        things.push({ part, corners, depth: corners.reduce((sum, p) => sum + p[2], 0) / corners.length });
      } else points.forEach((p) => { if (p) things.push({ part, corners: [p], depth: p[2] + extent }); });
    });
    things.sort((one, other) => one.depth - other.depth);
    for (const { part, corners } of things) {
      context.beginPath();
      if (part.faces) corners.forEach((p) => context.lineTo(...place(p)));
      else context.arc(...place(corners[0]), 3.5 * ratio, 0, 7);
      context.closePath();
      context.fillStyle = context.strokeStyle = part.color;
      context.globalAlpha = part.faces ? 0.16 : 1; context.fill();
      context.globalAlpha = part.faces ? 0.3 : 1; context.lineWidth = 0.6 * ratio; context.stroke();
    }
    const bar = 10 ** Math.floor(Math.log10(extent / 3));
    context.globalAlpha = 1; context.fillStyle = "#1f2933"; context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.fillRect(12 * ratio, canvas.height - 12 * ratio, bar * scale, 2 * ratio);
    context.fillText(`${bar} mm`, 12 * ratio, canvas.height - 17 * ratio);
    find("time").value = state.frame;
    find("state").textContent = `${about.time[state.frame].toFixed(3)} s`;
  }

  function show(number) { state.frame = Math.min(Math.max(number, 0), about.time.length - 1); draw(); }
  function play() {
    if (state.clock) { clearInterval(state.clock); state.clock = null; }
    else state.clock = setInterval(() => show((state.frame + 1) % about.time.length), 80);
    find("play").textContent = state.clock ? "Stop" : "Play";
  }
  about.parts.forEach((part, number) => {
    const label = document.createElement("label"), input = document.createElement("input");
    Object.assign(input, { type: "checkbox", checked: true });
    input.onchange = () => { state.hidden[input.checked ? "delete" : "add"](number); draw(); };
    label.append(input, part.name); label.style.color = part.color;
    find("parts").append(label);
  });
  find("time").max = about.time.length - 1;
  find("time").oninput = (event) => show(Number(event.target.value));
  find("play").onclick = play;
  let from = null;
  canvas.onpointerdown = (event) => { from = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointerup = () => { from = null; };
  canvas.onpointermove = (event) => {
    if (!from) return;
    state.azimuth -= 0.5 * (event.clientX - from[0]);
    state.elevation = Math.min(Math.max(state.elevation + 0.5 * (event.clientY - from[1]), -90), 90);
    from = [event.clientX, event.clientY]; draw();
  };
  window.addEventListener("resize", draw);
  box.hidden = false;
  draw();
}
