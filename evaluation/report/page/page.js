"use strict";
// What the page can do beyond being read: sort tables, zoom figures, play animations.
(() => {
  const root = document.documentElement;
  const make = (tag, attributes = {}, ...children) => {
    const node = tag.startsWith("svg:")
      ? document.createElementNS("http://www.w3.org/2000/svg", tag.slice(4))
      : document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  // ---------------------------------------------------------------- theme

  function theme(button) {
    const themes = ["system", "light", "dark"];
    const remembered = () => { try { return localStorage.getItem("slipcar-theme"); } catch { return null; } };
    const show = (name) => {
      if (name === "system") delete root.dataset.theme; else root.dataset.theme = name;
      button.textContent = `Theme: ${name}`;
      button.value = name;
      try { localStorage.setItem("slipcar-theme", name); } catch { /* not for files, in some browsers */ }
    };
    button.hidden = false;
    button.addEventListener("click", () => show(themes[(themes.indexOf(button.value) + 1) % 3]));
    show(themes.includes(remembered()) ? remembered() : "system");
  }

  // ---------------------------------------------------------------- tables

  // Each header sorts upwards, downwards, then as written. Rows without a number stay last.
  function sortable(table) {
    const body = table.tBodies[0];
    const written = [...body.rows];
    const headers = [...table.tHead.rows[0].cells];
    const texts = new Intl.Collator("en", { numeric: true });
    headers.forEach((header, column) => {
      const numeric = written.some((row) => row.cells[column].dataset.v !== undefined);
      const button = make("button", { type: "button" }, ...header.childNodes);
      header.append(button);
      header.setAttribute("aria-sort", "none");
      const key = (row) => {
        const cell = row.cells[column];
        if (!numeric) return cell.textContent;
        return cell.dataset.v === undefined ? null : Number(cell.dataset.v);
      };
      button.addEventListener("click", () => {
        const next = { none: "ascending", ascending: "descending", descending: "none" };
        const order = next[header.getAttribute("aria-sort")];
        for (const other of headers) other.setAttribute("aria-sort", other === header ? order : "none");
        const sign = order === "descending" ? -1 : 1;
        const rows = [...written];
        if (order !== "none") rows.sort((a, b) => {
          const [p, q] = [key(a), key(b)];
          if (p === null || q === null) return (p === null) - (q === null);
          return sign * (numeric ? p - q : texts.compare(p, q));
        });
        body.append(...rows);
      });
    });
  }

  // ---------------------------------------------------------------- figures

  function lightbox(dialog) {
    const stage = dialog.querySelector(".stage");
    const shown = dialog.querySelector("output");
    const text = dialog.querySelector("p");
    const link = dialog.querySelector("a");
    const fingers = new Map();
    let image = null, scale = 1, x = 0, y = 0, ratio = 1;

    const whole = () => {
      const room = stage.getBoundingClientRect();
      const width = Math.min(0.96 * room.width, 0.96 * room.height * ratio);
      return { room, width, height: width / ratio };
    };
    // (x, y): offset of the figure's middle from the stage's. A width rather than a transform:
    // drawn again at every size, and so always sharp.
    const place = () => {
      const { room, width, height } = whole();
      const reach = (size, span) => Math.max(0, (scale * size - span) / 2) + 0.25 * Math.min(scale * size, span);
      x = clamp(x, -reach(width, room.width), reach(width, room.width));
      y = clamp(y, -reach(height, room.height), reach(height, room.height));
      image.style.width = `${scale * width}px`;
      image.style.left = `${(room.width - scale * width) / 2 + x}px`;
      image.style.top = `${(room.height - scale * height) / 2 + y}px`;
      shown.value = `${Math.round(100 * scale)} %`;
    };
    const zoom = (factor, at) => {
      const room = stage.getBoundingClientRect();
      const [px, py] = at ? [at[0] - room.left - room.width / 2, at[1] - room.top - room.height / 2] : [0, 0];
      const next = clamp(scale * factor, 1, 20);
      [x, y] = [px + (x - px) * (next / scale), py + (y - py) * (next / scale)];
      scale = next;
      place();
    };
    const reset = () => { [scale, x, y] = [1, 0, 0]; place(); };

    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : event.ctrlKey ? 0.01 : 0.002)), [event.clientX, event.clientY]);
    }, { passive: false });
    stage.addEventListener("dblclick", reset);
    stage.addEventListener("pointerdown", (event) => {
      stage.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    stage.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY];
      const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
      fingers.set(event.pointerId, now);
      if (other) {
        const apart = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
        zoom(apart(now) / Math.max(apart(before), 1), [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
      }
      const share = other ? 0.5 : 1;
      x += share * (now[0] - before[0]);
      y += share * (now[1] - before[1]);
      place();
    });
    for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, (event) => fingers.delete(event.pointerId));
    const acts = { in: () => zoom(1.4), out: () => zoom(1 / 1.4), reset, close: () => dialog.close() };
    for (const button of dialog.querySelectorAll("[data-do]")) button.addEventListener("click", acts[button.dataset.do]);
    dialog.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      const keys = { "+": acts.in, "=": acts.in, "-": acts.out, 0: reset };
      if (moves[event.key]) { x += moves[event.key][0]; y += moves[event.key][1]; place(); }
      else if (keys[event.key]) keys[event.key]();
      else return;
      event.preventDefault();
    });
    addEventListener("resize", () => { if (dialog.open) place(); });
    dialog.addEventListener("close", () => { fingers.clear(); stage.replaceChildren(); });

    return (figure) => {
      ratio = figure.naturalWidth / figure.naturalHeight || 1.5;
      image = make("img", { src: figure.src, alt: figure.alt, draggable: "false" });
      stage.replaceChildren(image);
      text.textContent = figure.alt;
      link.href = figure.src;
      link.download = figure.dataset.name + (figure.src.startsWith("data:image/svg") ? ".svg" : ".png");
      dialog.showModal();
      reset();
    };
  }

  function zoomable(figure, open) {
    const button = make("button", { type: "button", class: "figure-button", "aria-label": `Enlarge: ${figure.alt}` });
    figure.replaceWith(button);
    button.append(figure);
    button.addEventListener("click", () => open(figure));
  }

  // ---------------------------------------------------------------- animations

  // The world from above, y upwards; `layer` is where paths are drawn, in metres.
  function world(scene, label) {
    const xs = [], ys = [];
    const see = (x, y, r = 0) => { xs.push(x - r, x + r); ys.push(y - r, y + r); };
    for (const [x, y, r] of scene.obstacles) see(x, y, r + scene.clearance);
    for (const [x, y] of [scene.start, scene.goal]) see(x, y);
    for (const row of scene.rows) for (const path of row.paths) for (const [x, y] of path) see(x, y);
    for (const step of scene.iterates?.steps ?? []) for (const [x, y] of step.path) see(x, y);
    const span = (values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    const [left, right] = span(xs), [low, high] = span(ys);
    const size = Math.max(right - left, high - low) || 1, pad = 0.05 * size;
    const box = [left - pad, low - pad, right - left + 2 * pad, high - low + 2 * pad];
    const fixed = { "vector-effect": "non-scaling-stroke" };
    const svg = make("svg:svg", { viewBox: `${box[0]} ${-box[1] - box[3]} ${box[2]} ${box[3]}`, role: "img", "aria-label": label });
    const ground = make("svg:g", { transform: "scale(1 -1)" });
    for (let x = Math.ceil(box[0]); x <= box[0] + box[2]; x++) ground.append(make("svg:path", { class: "grid", d: `M${x} ${box[1]}V${box[1] + box[3]}`, ...fixed }));
    for (let y = Math.ceil(box[1]); y <= box[1] + box[3]; y++) ground.append(make("svg:path", { class: "grid", d: `M${box[0]} ${y}H${box[0] + box[2]}`, ...fixed }));
    for (const [cx, cy, r] of scene.obstacles) ground.append(
      make("svg:circle", { class: "clearance", cx, cy, r: r + scene.clearance, ...fixed }),
      make("svg:circle", { class: "obstacle", cx, cy, r, ...fixed }));
    const layer = make("svg:g");
    const star = [...Array(10)].map((_, i) => {
      const r = size * (i % 2 ? 0.011 : 0.026), a = Math.PI * (0.5 + i / 5);
      return `${scene.goal[0] + r * Math.cos(a)} ${scene.goal[1] + r * Math.sin(a)}`;
    });
    const marks = make("svg:g", {},
      make("svg:circle", { class: "start", cx: scene.start[0], cy: scene.start[1], r: 0.014 * size, ...fixed }),
      make("svg:polygon", { class: "goal", points: star.join(" "), ...fixed }));
    ground.append(layer, marks);
    const corner = [box[0] + box[2] - 0.03 * size, -box[1] - 0.03 * size];
    const unit = size > 12 ? 5 : 1;
    svg.append(ground,
      make("svg:path", { class: "scale", d: `M${corner[0]} ${corner[1]}h${-unit}`, ...fixed }),
      make("svg:text", { x: corner[0], y: corner[1] - 0.016 * size, "font-size": 0.026 * size, "text-anchor": "end" }, `${unit} m`));
    return { svg, layer, size, fixed };
  }

  // A play button and a slider over [0, end]; draw(position) is told of every change.
  function player(name, end, seconds, draw, tell) {
    const button = make("button", { type: "button", "aria-label": `Play: ${name}` }, "▶ Play");
    const slider = make("input", { type: "range", min: 0, max: end, step: "any", "aria-label": name });
    const told = make("output");
    const bar = make("div", { class: "controls" }, button, slider, told);
    let playing = false, position = end, last = 0;
    const show = (value) => {
      position = clamp(value, 0, end);
      slider.value = position;
      told.value = tell(position);
      slider.setAttribute("aria-valuetext", told.value);
      draw(position);
    };
    const run = (now) => {
      if (!playing) return;
      show(position + (end / seconds) * Math.min((now - last) / 1000, 0.1));
      last = now;
      if (position >= end) stop(); else requestAnimationFrame(run);
    };
    const stop = () => {
      playing = false;
      button.textContent = "▶ Play";
      button.setAttribute("aria-label", `Play: ${name}`);
    };
    button.addEventListener("click", () => {
      if (playing) return stop();
      playing = true;
      button.textContent = "❚❚ Pause";
      button.setAttribute("aria-label", `Pause: ${name}`);
      if (position >= end) show(0);
      requestAnimationFrame((now) => { last = now; run(now); });
    });
    slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
    return { bar, show, again: () => show(position) };
  }

  const VIRIDIS = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
  const points = (path) => path.map(([x, y]) => `${x},${y}`).join(" ");

  function iteratesPlayer(scene) {
    const { name, guess, steps } = scene.iterates;
    const { svg, layer, fixed } = world(scene, `Iterates of the plan “${name}”, seen from above`);
    const end = steps.length - 1;
    const colour = (i) => { // the last is darkest on paper, and brightest in the dark
      const at = end ? i / end : 1;
      return `--light:${VIRIDIS[Math.round(8 * (1 - at))]};--dark:${VIRIDIS[Math.round(2 + 7 * at)]}`;
    };
    const lines = steps.map((step, i) => make("svg:polyline", { class: guess && i === 0 ? "iterate guess" : "iterate", style: colour(i), points: points(step.path), ...fixed }));
    const now = make("svg:polyline", { class: "iterate now", ...fixed });
    layer.append(...lines, now);
    const readout = make("p", { class: "readout" });
    const title = (i) => guess && i === 0 ? "Initial guess" : `Iterate ${guess ? i : i + 1} of ${guess ? end : end + 1}`;
    const draw = (position) => {
      const i = Math.min(Math.floor(position + 1e-9), end), rest = position - i;
      const ease = rest > 0 ? 0.5 - 0.5 * Math.cos(Math.PI * rest) : 0;
      const [a, b] = [steps[i].path, steps[Math.min(i + 1, end)].path];
      now.setAttribute("points", points(a.map(([x, y], k) => [x + ease * (b[k][0] - x), y + ease * (b[k][1] - y)])));
      now.setAttribute("style", colour(Math.round(position)));
      lines.forEach((line, k) => line.setAttribute("visibility", k <= i ? "visible" : "hidden"));
      const step = steps[Math.round(position)];
      const cost = step.effort === undefined ? "" : `: effort ${step.effort.toFixed(3)}, obstacles ${step.penalty.toFixed(3)}`;
      readout.textContent = title(Math.round(position)) + cost;
    };
    const play = player("iterates of the plan", end || 1, 0.7 * (end || 1), draw, (position) => title(Math.round(position)));
    play.bar.querySelector("output").hidden = true;
    const box = make("div", { class: "player iterates" }, make("h3", {}, "How the plan converges"),
      make("p", {}, `“${name}”: every accepted iterate of the planner, one after the other, from a guess to the plan.`), svg, play.bar, readout);
    play.show(end);
    return box;
  }

  function drivePlayer(scene) {
    const { svg, layer, size, fixed } = world(scene, "Cars of all rows, seen from above");
    const times = scene.times, last = times.length - 1, count = scene.rows[0].paths.length;
    const shape = "M-1 -.6 1.3 0-1 .6-.5 0z", cross = "M-1-1 1 1M-1 1 1-1";
    const chips = make("fieldset", { class: "chips", "aria-label": "Rows shown" });
    const rows = scene.rows.map((row, i) => {
      // Eight colours; when they come round again, other dashes.
      const look = { class: (row.closed ? "closed" : "open") + (i % 16 > 7 ? " again" : ""), style: `--c:var(--c${i % 8})` };
      const group = make("svg:g", look);
      const cars = row.paths.map((path, j) => {
        const trail = make("svg:polyline", { class: "trail", ...fixed });
        const car = make("svg:path", { class: "vehicle", d: shape, ...fixed });
        const hit = row.hits[j] === null ? null : make("svg:path", { class: "hit", d: cross, ...fixed,
          transform: `translate(${path[row.hits[j]].slice(0, 2)}) scale(${0.011 * size})` });
        const part = make("svg:g", {}, trail, car, ...(hit ? [hit] : []));
        group.append(part);
        const so_far = [];
        path.reduce((text, [x, y], k) => (so_far[k] = `${text} ${x},${y}`), "");
        return { path, trail, car, hit, at: row.hits[j], part, so_far };
      });
      layer.append(group);
      const box = make("input", { type: "checkbox" });
      box.checked = row.shown;
      const label = make("label", look, box, make("i"), row.name);
      const hits = row.hits.filter((at) => at !== null).length;
      if (hits) label.append(make("em", {}, `${hits} of ${count} hit`));
      chips.append(label);
      box.addEventListener("change", () => play.again());
      return { group, cars, box };
    });
    const which = make("select", { "aria-label": "Brownian paths shown" }, make("option", { value: -1 }, `all ${count} paths`),
      ...[...Array(count).keys()].map((j) => make("option", { value: j }, `path ${j + 1}`)));
    const draw = (t) => {
      const chosen = Number(which.value);
      let k = 0;
      while (k < last - 1 && times[k + 1] <= t) k++;
      const part = clamp((t - times[k]) / (times[k + 1] - times[k]), 0, 1);
      svg.classList.toggle("one", chosen >= 0);
      for (const { group, cars, box } of rows) {
        group.setAttribute("visibility", box.checked ? "visible" : "hidden");
        group.setAttribute("display", box.checked ? "inline" : "none");
        if (!box.checked) continue;
        cars.forEach((car, j) => {
          const seen = chosen < 0 || chosen === j;
          car.part.setAttribute("display", seen ? "inline" : "none");
          if (!seen) return;
          const [a, b] = [car.path[k], car.path[k + 1]];
          const [x, y, angle] = a.map((value, i) => value + part * (b[i] - value));
          car.trail.setAttribute("points", `${car.so_far[k]} ${x},${y}`);
          car.car.setAttribute("transform", `translate(${x} ${y}) rotate(${(180 / Math.PI) * angle}) scale(${0.015 * size})`);
          car.hit?.setAttribute("display", t >= times[car.at] - 1e-9 ? "inline" : "none");
        });
      }
    };
    const end = times[last];
    const told = scene.substeps === 1
      ? `The first ${count} paths of the evaluation (seed ${scene.seed}), joined at the nodes.`
      : `${count} paths (seed ${scene.seed}) of one Euler–Maruyama step between nodes, not of ${scene.substeps}.`;
    const play = player("drive", end, Math.max(end, 3), draw, (t) => `${t.toFixed(2)} s`);
    play.bar.append(which);
    which.addEventListener("change", () => play.again());
    const all = (checked) => () => { for (const row of rows) row.box.checked = checked; play.again(); };
    const [every, none] = ["All", "None"].map((text) => make("button", { type: "button" }, text));
    every.addEventListener("click", all(true));
    none.addEventListener("click", all(false));
    chips.append(every, none);
    const box = make("div", { class: "player drive" }, make("h3", {}, "Every row over the same Brownian paths"),
      make("p", {}, `${told} Dashed or dotted: open loop. A cross: a collision.`),
      svg, play.bar, chips);
    play.show(end);
    return box;
  }

  // ---------------------------------------------------------------- all of it

  root.classList.add("scripts");
  theme(document.getElementById("theme"));
  document.querySelectorAll("table").forEach(sortable);
  const open = lightbox(document.getElementById("lightbox"));
  for (const figure of document.querySelectorAll("figure > img")) zoomable(figure, open);
  for (const place of document.querySelectorAll(".animation")) {
    const scene = JSON.parse(place.querySelector("script").textContent);
    if (scene.iterates) place.append(iteratesPlayer(scene));
    if (scene.rows.length) place.append(drivePlayer(scene));
  }
})();
