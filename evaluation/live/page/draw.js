// Pictures: an answer's bytes into arrays, arrays onto the canvas, the plane onto the screen.

// Length of the header, header in JSON, float32 arrays in a row.
export function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  let offset = 4 + length;
  for (const [name, shape] of facts.arrays) {
    const size = shape.reduce((a, b) => a * b, 1);
    arrays[name] = { shape, data: new Float32Array(buffer, offset, size) };
    offset += 4 * size;
  }
  return { facts, arrays };
}

// What maps metres to pixels so that all points, with their radii, are in sight.
export function fitted(points, width, height) {
  const pad = 0.5;
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y, r = 0] of points) {
    left = Math.min(left, x - r - pad); right = Math.max(right, x + r + pad);
    low = Math.min(low, y - r - pad); high = Math.max(high, y + r + pad);
  }
  const scale = Math.min(width / (right - left), height / (high - low));
  return { scale, x0: width / 2 - scale * (left + right) / 2,
    y0: height / 2 + scale * (low + high) / 2 };
}

export const toScreen = (v, x, y) => [v.x0 + v.scale * x, v.y0 - v.scale * y];
export const toPlane = (v, px, py) => [(px - v.x0) / v.scale, (v.y0 - py) / v.scale];

function line(c, v, data, first, nodes) {
  let begun = false;
  for (let k = first; k < first + nodes; k++) {
    const x = data[2 * k], y = data[2 * k + 1];
    if (!Number.isFinite(x + y)) break;
    const [px, py] = toScreen(v, x, y);
    if (begun) c.lineTo(px, py); else c.moveTo(px, py);
    begun = true;
  }
}

// Paths of one colour in one stroke each: free ones, then those that collide.
function cloud(c, v, paths, broken, colour, hit) {
  const [count, nodes] = paths.shape;
  for (const wanted of [0, 1]) {
    c.beginPath();
    for (let i = 0; i < count; i++) {
      if ((broken ? broken.data[i] : 0) === wanted) line(c, v, paths.data, i * nodes, nodes);
    }
    c.strokeStyle = wanted ? hit : colour;
    c.globalAlpha = wanted ? 0.85 : 0.22;
    c.stroke();
  }
  c.globalAlpha = 1;
}

export function draw(canvas, v, world, clearance, picture, stale) {
  const c = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, canvas.width, canvas.height);
  for (const [x, y, r] of world.obstacles || []) {
    const [px, py] = toScreen(v, x, y);
    c.beginPath(); c.arc(px, py, v.scale * r, 0, 7);
    c.fillStyle = colour("obstacle"); c.fill();
    c.strokeStyle = colour("rim"); c.lineWidth = 1.5; c.stroke();
    if (clearance) {
      c.beginPath(); c.arc(px, py, v.scale * (r + clearance), 0, 7);
      c.setLineDash([4, 4]); c.lineWidth = 1; c.stroke(); c.setLineDash([]);
    }
  }
  if (!picture) return;
  const { arrays } = picture;
  c.lineWidth = 1; c.lineJoin = "round";
  if (stale) c.filter = "opacity(35%)";
  if (arrays.policy) cloud(c, v, arrays.policy, null, colour("learned"), colour("hit"));
  if (arrays.cloud) cloud(c, v, arrays.cloud, arrays.broken, colour("paths"), colour("hit"));
  if (arrays.ellipses) {
    const e = arrays.ellipses.data;
    c.beginPath();
    for (let i = 0; i < e.length; i += 5) {
      const [px, py] = toScreen(v, e[i], e[i + 1]);
      c.moveTo(px + v.scale * e[i + 2] * Math.cos(e[i + 4]), py - v.scale * e[i + 2] * Math.sin(e[i + 4]));
      c.ellipse(px, py, v.scale * e[i + 2], v.scale * e[i + 3], -e[i + 4], 0, 2 * Math.PI);
    }
    c.fillStyle = c.strokeStyle = colour("ellipse");
    c.globalAlpha = 0.25; c.fill(); c.globalAlpha = 1; c.stroke();
  }
  for (const [name, width] of [["mean", 3], ["trail", 4]]) {
    if (!arrays[name]) continue;
    c.beginPath(); line(c, v, arrays[name].data, 0, arrays[name].shape[0]);
    c.strokeStyle = colour(name === "mean" ? "plan" : "trail"); c.lineWidth = width; c.stroke();
  }
  c.filter = "none";
  const trail = arrays.trail;
  if (trail) {
    const last = 2 * (trail.shape[0] - 1);
    const [px, py] = toScreen(v, trail.data[last], trail.data[last + 1]);
    c.beginPath(); c.arc(px, py, 8, 0, 7); c.fillStyle = colour("trail"); c.fill();
  }
}
