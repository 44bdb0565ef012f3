"use strict";
(() => {
  const shots = JSON.parse(document.getElementById("films").textContent);
  if (!shots.length) return;

  const find = (selector) => document.querySelector(selector);
  const player = find(".player"), panesBox = find(".panes"), drivers = find(".drivers");
  const play = find(".play"), scrubber = find(".controls input"), speed = find(".controls select"), readout = find(".readout");
  const buttons = [...document.querySelectorAll(".episodes button")];
  const stillness = matchMedia("(prefers-reduced-motion: reduce)"), darkness = matchMedia("(prefers-color-scheme: dark)");
  const TRAIL = 1.5; // seconds
  const MOST = 3; // films side by side

  // `shot` is a start, `wanted` the names of the drivers that are shown, `frame` the time of all of them
  let shot = shots[0], wanted = [], frame = 0, playing = false, before = 0, request = 0, pace = 1, colours = {};
  const model = find(".pane"), panes = [];

  // ---- small tools ----

  const last = () => Math.max(...panes.map((pane) => pane.last()));
  const step = () => panes[0].film().dt;
  const known = (point) => point && point.every((value) => value !== null);
  const mix = (a, b, f) => a + (b - a) * f;
  const say = (value) => value === null || value === undefined ? "–" : (value !== 0 && Math.abs(value) < 1e-3 ? value.toExponential(1) : value.toFixed(3)).replace("-", "\u2212");

  function readColours() {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["raised", "ink", "soft", "rule", "faint", "alarm", "accent", "c0", "c1", "c2", "c3", "c4", "c5"]) {
      colours[name] = style.getPropertyValue("--" + name).trim();
    }
  }
  const colourOf = (agent) => colours["c" + (agent % 6)];

  function prepare(canvas) { // sharp on every screen; returns the context and the size in CSS pixels
    const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = pen.lineCap = "round";
    pen.font = "11px system-ui, sans-serif";
    return { pen, width, height };
  }

  function roundStep(span, about) {
    const power = 10 ** Math.floor(Math.log10(span / about));
    return power * [1, 2, 5, 10].find((m) => m * power >= 0.8 * span / about);
  }

  function write(pen, text, x, y) { // readable across a line
    pen.strokeStyle = colours.raised; pen.lineWidth = 3;
    pen.strokeText(text, x, y); pen.fillText(text, x, y);
  }

  // ---- one film: its scene and its strips ----

  const MARGIN = 48, ROW = 84;

  function paneOf(film, box) {
    const scene = box.querySelector(".scene"), strip = box.querySelector(".strip"), end = film.steps - 1;
    const at = () => Math.min(frame, end);
    if (film.panels.length === 1 && !film.panels[0].lanes) { // a row of bodies needs no square
      const [left, right, bottom, top] = film.panels[0].window, tall = (top - bottom) / (right - left);
      if (tall < 0.9) scene.style.aspectRatio = String(1 / tall);
    }
    const bodyColour = (body) => colourOf(film.tints[body]);

    function position(agent, time) {
      const k = Math.floor(time), a = film.positions[k][agent], b = film.positions[Math.min(k + 1, end)][agent];
      if (!known(a)) return null;
      return known(b) ? a.map((value, axis) => mix(value, b[axis], time - k)) : a;
    }

    function heading(agent, time) {
      if (!film.headings) return null;
      const k = Math.floor(time), a = film.headings[k][agent], b = film.headings[Math.min(k + 1, end)][agent];
      if (a === null || b === null) return a;
      const turn = Math.atan2(Math.sin(b - a), Math.cos(b - a));
      return a + turn * (time - k);
    }

    // ---- the scene ----

    function drawScene() {
      scene.hidden = !film.panels.length;
      if (scene.hidden) return;
      const { pen, width, height } = prepare(scene), shapes = film.panels.map(({ window: [left, right, bottom, top] }) => (top - bottom) / (right - left));
      const whole = shapes.reduce((a, b) => a + b);
      let top = 0;
      film.panels.forEach((panel, n) => {
        const room = film.panels.length > 1 ? height * shapes[n] / whole : height;
        pen.save(); pen.translate(0, top);
        pen.beginPath(); pen.rect(0, 0, width, room); pen.clip();
        drawPanel(pen, panel, width, room);
        pen.restore();
        top += room;
        if (n + 1 < film.panels.length) drawLine(pen, colours.rule, 0, Math.round(top) + 0.5, width, Math.round(top) + 0.5);
      });
    }

    function drawPanel(pen, panel, width, height) {
      const [left, right, bottom, top] = panel.window, [a, b] = panel.axes;
      const fit = Math.min(width / (right - left), height / (top - bottom));
      const scale = panel.lanes ? [width / (right - left), height / (top - bottom)] : [fit, fit];
      const middle = [(left + right) / 2, (bottom + top) / 2];
      const place = (point) => [width / 2 + (point[a] - middle[0]) * scale[0], height / 2 - (point[b] - middle[1]) * scale[1]];
      const size = Math.max(7, Math.min(11, width / 60)), agents = film.positions[0].length;
      drawGrid(pen, panel, width, height, middle, scale);
      const goals = film.goals[Math.min(Math.floor(at()), film.goals.length - 1)];
      goals.forEach((goal, k) => known(goal) && drawTarget(pen, place(goal), film.radius * scale[0], goals.length > 1 ? colourOf(k) : colours.ink, panel.lanes && 0.35 * scale[1]));
      const spots = [];
      for (let i = 0; i < agents; i++) {
        const spot = position(i, at());
        spots.push(spot && place(spot));
      }
      drawEdges(pen, spots);
      for (const [i, j] of film.rods) if (spots[i] && spots[j]) drawRod(pen, spots[i], spots[j], bodyColour(i));
      for (let i = 0; i < agents; i++) drawTrail(pen, place, i, spots[i]);
      for (let i = 0; i < agents; i++) if (spots[i]) drawAgent(pen, spots[i], b === 1 ? heading(i, at()) : null, size, bodyColour(i), film.leaders[i]);
    }

    function drawLine(pen, colour, a, b, c, d) {
      pen.strokeStyle = colour; pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(a, b); pen.lineTo(c, d); pen.stroke();
    }

    function drawGrid(pen, panel, width, height, [x0, y0], [across, up]) {
      const step = roundStep((panel.lanes ? width : Math.min(width, scene.clientHeight)) / across, Math.max(2, Math.min(5, width / 75))), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      const unit = film.unit && " " + film.unit, label = (value) => (Math.abs(value) < step / 2 ? 0 : value).toFixed(digits).replace("-", "\u2212") + unit;
      pen.fillStyle = colours.soft;
      for (let k = Math.ceil((x0 - width / 2 / across) / step); k * step < x0 + width / 2 / across; k++) {
        const x = Math.round(width / 2 + (k * step - x0) * across) + 0.5;
        drawLine(pen, colours.faint, x, 0, x, height);
        if (x > 30 && x < width - 30) write(pen, label(k * step), x + 4, height - 6);
      }
      const rows = panel.lanes ? 1 : step;
      for (let k = Math.ceil((y0 - height / 2 / up) / rows); k * rows < y0 + height / 2 / up; k++) {
        const y = Math.round(height / 2 - (k * rows - y0) * up) + 0.5;
        drawLine(pen, colours.faint, 0, y, width, y);
        if (y > 12 && y < height - 20) write(pen, panel.lanes ? -k : label(k * step), 5, y - 4);
      }
      if (film.panels.length > 1) pen.fillText(panel.labels[1], width - 40, 14);
    }

    function drawTarget(pen, [x, y], radius, colour, half) { // a ring, or on a road a stretch of the lane
      const r = Math.max(radius, 3);
      pen.beginPath();
      if (half) pen.rect(x - r, y - half, 2 * r, 2 * half);
      else pen.arc(x, y, r, 0, 2 * Math.PI);
      pen.globalAlpha = 0.07; pen.fillStyle = colour; pen.fill(); pen.globalAlpha = 1;
      pen.strokeStyle = colour; pen.lineWidth = 1.4; pen.setLineDash([4, 3]); pen.stroke(); pen.setLineDash([]);
    }

    function drawEdges(pen, spots) {
      const edges = film.edges[Math.min(Math.floor(at()), film.edges.length - 1)] || [];
      pen.strokeStyle = colours.soft; pen.lineWidth = 1; pen.globalAlpha = 0.5;
      for (const [i, j] of edges) {
        if (!spots[i] || !spots[j]) continue;
        pen.beginPath(); pen.moveTo(...spots[i]); pen.lineTo(...spots[j]); pen.stroke();
      }
      pen.globalAlpha = 1;
    }

    function drawRod(pen, a, b, colour) {
      pen.strokeStyle = colour; pen.lineWidth = 4;
      pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b); pen.stroke();
    }

    function drawTrail(pen, place, agent, spot) { // the whole path faintly, the last moments strongly
      const path = film.positions.map((row) => known(row[agent]) ? place(row[agent]) : null);
      pen.strokeStyle = bodyColour(agent);
      const segment = (a, b, alpha, width) => {
        if (!a || !b) return;
        pen.globalAlpha = alpha; pen.lineWidth = width;
        pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b); pen.stroke();
      };
      pen.lineCap = "butt";
      for (let k = 1; k < path.length; k++) segment(path[k - 1], path[k], 0.35, 1);
      const now = Math.floor(at()), first = Math.max(1, Math.ceil(at() - TRAIL / film.dt));
      for (let k = first; k <= now; k++) segment(path[k - 1], path[k], Math.max(0.05, 1 - (at() - k + 1) * film.dt / TRAIL), 2.6);
      segment(path[now], spot, 1, 2.6);
      pen.globalAlpha = 1; pen.lineCap = "round";
    }

    function drawAgent(pen, [x, y], angle, size, colour, leader) {
      pen.save(); pen.translate(x, y);
      pen.strokeStyle = colour; pen.fillStyle = leader ? colour : colours.raised; pen.lineWidth = 2;
      if (leader) { pen.beginPath(); pen.arc(0, 0, 1.75 * size, 0, 2 * Math.PI); pen.lineWidth = 1.5; pen.stroke(); pen.lineWidth = 2; }
      pen.beginPath();
      if (angle === null) pen.arc(0, 0, 0.75 * size, 0, 2 * Math.PI);
      else { pen.rotate(-angle); pen.moveTo(1.2 * size, 0); pen.lineTo(-0.8 * size, 0.75 * size); pen.lineTo(-0.8 * size, -0.75 * size); pen.closePath(); }
      pen.fill(); pen.stroke(); pen.restore();
    }

    // ---- the strip ----

    function drawStrip() {
      const rows = film.strips, tall = 22 + ROW * rows.length * (film.panels.length ? 1 : 1.4);
      if (strip.style.height !== tall + "px") strip.style.height = tall + "px";
      const { pen, width, height } = prepare(strip), box = { left: MARGIN, right: width - 8, pen };
      const room = (height - 22) / Math.max(rows.length, 1);
      rows.forEach((row, k) => drawRow(box, row, k * room + 22, (k + 1) * room - 4));
      pen.fillStyle = colours.soft; pen.textAlign = "center";
      const seconds = end * film.dt, step = roundStep(Math.max(seconds, film.dt), width < 500 ? 4 : 8);
      for (let k = 0; k * step <= seconds + 1e-9; k++) {
        const x = mix(box.left, box.right, seconds ? k * step / seconds : 0);
        pen.fillText(+(k * step).toFixed(3) + (k * step + step > seconds + 1e-9 ? " s" : ""), Math.min(x, width - 12), height - 5);
      }
      pen.textAlign = "left";
    }

    function drawRow({ pen, left, right }, { name, lines, span: [low, high], rises, mark, agents }, top, bottom) {
      const n = Math.max(end, 1), x = (k) => mix(left, right, k / n), y = (v) => mix(bottom, top, (Math.max(low, Math.min(high, v)) - low) / (high - low));
      drawLine(pen, colours.rule, left, bottom + 0.5, right, bottom + 0.5);
      pen.fillStyle = colours.soft; pen.textAlign = "right";
      const digits = Math.max(0, 1 - Math.floor(Math.log10(high - low))), label = (v) => String(low ? v.toFixed(Math.min(digits, 9)) : +v.toPrecision(2)).replace("-", "\u2212");
      pen.fillText(label(low), left - 6, bottom + 2); pen.fillText(label(high), left - 6, top + 5);
      pen.textAlign = "left"; pen.fillText(name, left, top - 9);
      if (mark) {
        pen.setLineDash([4, 3]); drawLine(pen, colours.soft, left, y(mark), right, y(mark)); pen.setLineDash([]);
      }
      lines.forEach((values, agent) => {
        for (let k = 1; k < values.length; k++) {
          if (values[k] === null || values[k - 1] === null) continue;
          const alarm = rises && values[k] - values[k - 1] > 1e-3 * high;
          pen.strokeStyle = alarm ? colours.alarm : agents ? colourOf(agent) : colours.ink; pen.lineWidth = alarm ? 3 : 1.6;
          pen.beginPath(); pen.moveTo(x(k - 1), y(values[k - 1])); pen.lineTo(x(k), y(values[k])); pen.stroke();
        }
      });
      drawLine(pen, colours.accent, x(at()), top - 2, x(at()), bottom);
      const k = Math.floor(at());
      lines.forEach((values, agent) => {
        const a = values[k], b = values[Math.min(k + 1, end)];
        if (a === null || b === null) return;
        pen.fillStyle = agents ? colourOf(agent) : colours.accent;
        pen.beginPath(); pen.arc(x(at()), y(mix(a, b, at() - k)), 3.5, 0, 2 * Math.PI); pen.fill();
      });
    }

    function onStrip(event) {
      const { left, width } = strip.getBoundingClientRect();
      seek(Math.round((event.clientX - left - MARGIN) / (width - MARGIN - 8) * end));
    }
    strip.addEventListener("pointerdown", (event) => { strip.setPointerCapture(event.pointerId); onStrip(event); });
    strip.addEventListener("pointermove", (event) => { if (event.buttons) onStrip(event); });
    scene.addEventListener("click", () => setPlaying(!playing));

    const [name, ended] = [document.createElement("b"), document.createElement("span")];
    name.textContent = film.who; ended.textContent = film.ended;
    box.querySelector(".who").replaceChildren(name, " ", ended);
    return { draw() { drawScene(); drawStrip(); }, film: () => film, last: () => end };
  }

  // ---- time ----

  function draw() {
    for (const pane of panes) pane.draw();
    const k = Math.floor(frame), seconds = (k * step()).toFixed(step() < 0.1 ? 2 : 1);
    scrubber.value = k;
    scrubber.setAttribute("aria-valuetext", seconds + " seconds");
    readout.replaceChildren("t ", bold(seconds + " s"), ...panes.flatMap(said));
  }

  const bold = (text) => Object.assign(document.createElement("b"), { textContent: text });

  function said(pane) { // what a film reads now, after its driver's name where there are several
    const film = pane.film(), k = Math.min(Math.floor(frame), pane.last());
    const values = film.strips.filter((row) => !row.agents).flatMap((row, n) => {
      const [, name, unit] = row.name.match(/^(.*?)(?: \(([^)]*)\))?$/);
      return [(n || panes.length === 1 ? " · " : " ") + name + " ", bold(say(row.lines[0][k]) + (unit && !row.rises ? " " + unit : ""))];
    });
    return panes.length > 1 ? ["\n" + film.who + ":", ...values] : values;
  }

  function fitPace() { // in real time unless that would be over in a blink or take minutes
    const lasts = last() * step();
    pace = lasts > 1 && lasts < 60 || !lasts ? 1 : 10 ** Math.round(Math.log10(lasts / 8));
    for (const option of speed.options) {
      option.dataset.name ??= option.textContent;
      option.textContent = pace === 1 ? option.dataset.name : Number((option.value * pace).toPrecision(3)) + " × real time";
    }
  }

  function tick(now) {
    if (!playing) return;
    const passed = Math.max(0, now - before) / 1000 * Number(speed.value) * pace / step();
    if (!stillness.matches || passed >= 1) { // with reduced motion: from step to step, nothing in between
      const next = frame + passed;
      frame = Math.min(stillness.matches ? Math.floor(next) : next, last());
      before = now;
      draw();
    }
    if (frame >= last()) return setPlaying(false);
    request = requestAnimationFrame(tick);
  }

  function setPlaying(on) {
    playing = on;
    cancelAnimationFrame(request);
    play.textContent = on ? "Pause" : frame >= last() && last() > 0 ? "Again" : "Play";
    if (!on) return;
    if (frame >= last()) frame = 0;
    before = performance.now();
    request = requestAnimationFrame(tick);
  }

  function seek(to) {
    frame = Math.max(0, Math.min(last(), to));
    setPlaying(false);
    draw();
  }

  // ---- what is shown ----

  function choose(index) {
    shot = shots[(index + shots.length) % shots.length];
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(shots[k] === shot)));
    const names = shot.films.map((film) => film.who);
    wanted = wanted.filter((name) => names.includes(name));
    if (!wanted.length) wanted = names.slice(0, 2);
    drivers.hidden = find(".drivers-head").hidden = names.length < 2;
    drivers.replaceChildren(...names.map((name) => {
      const button = document.createElement("button");
      button.type = "button"; button.textContent = name;
      button.addEventListener("click", () => toggle(name));
      return button;
    }));
    setOut();
    seek(0);
  }

  function toggle(name) { // at least one stays; one too many pushes out the first
    if (!wanted.includes(name)) wanted = [...wanted, name].slice(-MOST);
    else if (wanted.length > 1) wanted = wanted.filter((other) => other !== name);
    const then = frame;
    setOut();
    seek(then);
  }

  function setOut() { // the panes of the films that are wanted
    const films = shot.films.filter((film) => wanted.includes(film.who));
    const boxes = films.map(() => model.cloneNode(true));
    panesBox.replaceChildren(...boxes);
    panesBox.dataset.count = films.length;
    panes.splice(0, panes.length, ...films.map((film, k) => paneOf(film, boxes[k])));
    for (const button of drivers.children) button.setAttribute("aria-pressed", String(wanted.includes(button.textContent)));
    scrubber.max = last();
    fitPace();
    explain(films);
  }

  function explain(films) { // the key: what can be seen and no more
    const strips = films.flatMap((film) => film.strips), falls = strips.find((row) => row.rises), some = (test) => films.some(test);
    const map = some((film) => film.panels.length), leaders = some((film) => film.leaders.includes(true)), aims = some((film) => film.goals[0].length);
    find(".rises").hidden = !falls;
    find(".rises span").textContent = (falls ? falls.name : "") + " rises (by over 0.1 % of its largest)";
    find(".leads").hidden = !leaders;
    find(".leads span").textContent = aims ? "leader, knows its goal" : "leader";
    find(".follows").hidden = !map || !some((film) => film.leaders.includes(false));
    find(".follows span").textContent = leaders ? "follower" : "agent";
    find(".linked").hidden = !map || !some((film) => film.edges.some((pairs) => pairs.length));
    find(".aims").hidden = !map || !aims;
    const pointed = some((film) => film.headings);
    for (const shape of document.querySelectorAll(".key .arrow")) shape.style.display = pointed ? "" : "none";
    for (const shape of document.querySelectorAll(".key .disc")) shape.style.display = pointed ? "none" : "";
  }

  function asText() { // the strips of all films of the start, one value a line
    const quoted = (text) => `"${String(text).replaceAll('"', '""')}"`, rows = ["driver,time (s),value,agent,number"];
    for (const film of shot.films) {
      for (const { name, lines, agents } of film.strips) {
        lines.forEach((values, agent) => values.forEach((value, k) => rows.push([quoted(film.who), +(k * film.dt).toPrecision(6), quoted(name), agents ? agent : "", value ?? ""].join(","))));
      }
    }
    return rows.join("\n") + "\n";
  }

  // ---- hands ----

  play.addEventListener("click", () => setPlaying(!playing));
  scrubber.addEventListener("input", () => seek(Number(scrubber.value)));
  buttons.forEach((button, k) => button.addEventListener("click", () => choose(k)));
  for (const button of document.querySelectorAll(".worst")) {
    button.addEventListener("click", () => {
      choose(Number(button.dataset.shot));
      find("#film").scrollIntoView({ behavior: stillness.matches ? "auto" : "smooth" });
      player.focus({ preventScroll: true });
    });
  }
  find(".controls .csv").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([asText()], { type: "text/csv" }));
    link.download = "film.csv";
    link.click();
    URL.revokeObjectURL(link.href);
  });
  player.addEventListener("keydown", (event) => {
    if (event.target === speed || event.altKey || event.ctrlKey || event.metaKey) return;
    const now = shots.indexOf(shot), stride = event.shiftKey ? 10 : 1;
    const keys = {
      " ": () => setPlaying(!playing),
      ArrowLeft: () => seek(Math.ceil(frame) - stride), ArrowRight: () => seek(Math.floor(frame) + stride),
      ArrowUp: () => choose(now - 1), ArrowDown: () => choose(now + 1),
      Home: () => seek(0), End: () => seek(last()),
    };
    if (!keys[event.key] || (event.key === " " && event.target.tagName === "BUTTON")) return;
    event.preventDefault();
    keys[event.key]();
  });
  darkness.addEventListener("change", () => { readColours(); draw(); });
  new ResizeObserver(draw).observe(player);

  find(".film").hidden = false;
  readColours();
  choose(0);
  document.documentElement.dataset.player = "ready";
})();
