// Replay of a run in a canvas, without any library: orbit with the mouse, play, pause, speed, slider with events.
(function (root, film) {
  "use strict";
  const canvas = root.querySelector("canvas"), pen = canvas.getContext("2d");
  const play = root.querySelector("button"), slider = root.querySelector("input");
  const speed = root.querySelector("select"), clock = root.querySelector("output");
  const marks = root.querySelector(".marks"), said = root.querySelector(".said");
  const LEVELS = ["rgb(0,158,115)", "rgb(230,159,0)", "rgb(213,50,30)", "rgb(140,140,140)"];
  const SIDES = 12, [low, high] = film.arena;
  const size = Math.hypot(high[0] - low[0], high[1] - low[1]);
  const middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.15 * Math.min(1.5, size / 4)];
  let turn = -0.9, tilt = 0.62, far = 1.35 * size, t = film.begin, playing = false, last = 0, colours;

  // place of a point in the picture of one case; depth grows away from the eye
  function projector(left, wide, tall) {
    const [ct, st, ci, si] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const scale = 1.15 * Math.min(tall * 1.25, wide);
    return (x, y, z) => {
      const [dx, dy, dz] = [x - middle[0], y - middle[1], z - middle[2]];
      const right = ct * dx + st * dy, ahead = -st * dx + ct * dy;
      const up = ci * dz + si * ahead, depth = far + ci * ahead - si * dz;
      const near = scale / Math.max(depth, 0.05);
      return [left + wide / 2 + near * right, tall / 2 - near * up, depth];
    };
  }
  function path(points, closed) {
    pen.beginPath();
    points.forEach((p, k) => (k ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
    if (closed) pen.closePath();
  }
  function stroke(points, colour, width, closed) {
    path(points, closed); pen.strokeStyle = colour; pen.lineWidth = width; pen.stroke();
  }
  function fill(points, colour) { path(points, true); pen.fillStyle = colour; pen.fill(); }
  function shade(c, f) { return `rgb(${c.map((v) => Math.round(Math.min(255, v * f))).join()})`; }

  // upright prism over a ring [[x, y], ...]: its walls from far to near, then its top
  function prism(at, ring, z0, z1, colour, alpha) {
    const walls = ring.map((a, k) => {
      const b = ring[(k + 1) % ring.length];
      const corners = [at(a[0], a[1], z0), at(b[0], b[1], z0), at(b[0], b[1], z1), at(a[0], a[1], z1)];
      return [corners, 0.62 + 0.2 * Math.cos(Math.atan2(b[1] - a[1], b[0] - a[0]) + 0.8)];
    });
    walls.sort((a, b) => b[0][0][2] + b[0][1][2] - a[0][0][2] - a[0][1][2]);
    pen.globalAlpha = alpha;
    for (const [corners, light] of walls) fill(corners, shade(colour, light));
    fill(ring.map((p) => at(p[0], p[1], z1)), shade(colour, 1));
    pen.globalAlpha = 1;
  }
  // sample and share of the next one at the present time
  function sample(one) {
    const k = Math.min(Math.max((t - one.begin) / one.step, 0), one.p.length - 1), i = Math.floor(k);
    return [i, Math.min(i + 1, one.p.length - 1), k - i];
  }
  function robots(one) {
    const [i, j, s] = sample(one), a = one.p[i], b = one.p[j];
    return film.names.map((name, n) => {
      const [p, q] = [a.slice(4 * n, 4 * n + 4), b.slice(4 * n, 4 * n + 4)];
      if (p[0] === null || q[0] === null) return null;
      const way = Math.atan2(Math.sin((q[3] - p[3]) / 1e3), Math.cos((q[3] - p[3]) / 1e3));
      return [0, 1, 2].map((c) => ((1 - s) * p[c] + s * q[c]) / 1e3).concat(p[3] / 1e3 + s * way);
    });
  }
  root.replay = { places: () => film.cases.map(robots), seek: (to) => { t = to; draw(); } };

  function scene(one, left, wide, tall) {
    const at = projector(left, wide, tall), places = robots(one), [i] = sample(one);
    pen.save(); pen.beginPath(); pen.rect(left, 0, wide, tall); pen.clip();
    const step = size > 12 ? 2 : 0.5;
    for (let x = low[0]; x <= high[0] + 1e-6; x += step) stroke([at(x, low[1], 0), at(x, high[1], 0)], colours.grid, 1);
    for (let y = low[1]; y <= high[1] + 1e-6; y += step) stroke([at(low[0], y, 0), at(high[0], y, 0)], colours.grid, 1);
    stroke([[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => at(u ? high[0] : low[0], v ? high[1] : low[1], 0)),
      colours.edge, 1.5, true);
    const things = [];
    film.obstacles.forEach((each, n) => {
      const [x, y, yaw] = one.o[i].slice(3 * n, 3 * n + 3).map((v) => v / 1e3), c = Math.cos(yaw), d = Math.sin(yaw);
      const ring = each.ring.map(([u, v]) => [x + c * u - d * v, y + d * u + c * v]);
      things.push([at(x, y, each.low)[2], () => each.closed
        ? prism(at, ring, each.low, each.high, [168, 172, 180], 0.7)
        : ring.slice(1).forEach((b, k) => fill([at(...ring[k], each.low), at(...b, each.low), at(...b, each.high),
          at(...ring[k], each.high)], "rgba(140,144,152,.55)"))]);
    });
    film.links.forEach(([from, to], n) => {
      const level = one.e[i][n], a = places[from], b = places[to];
      if (a === null || b === null || level < 0) return;
      const [p, q] = [at(a[0], a[1], a[2] + film.high[from] / 2), at(b[0], b[1], b[2] + film.high[to] / 2)];
      things.push([(p[2] + q[2]) / 2 + 0.01, () => stroke([p, q], LEVELS[level], 1.6)]);
    });
    places.forEach((p, n) => {
      if (p === null) return;
      const r = film.radius[n], top = p[2] + film.high[n], colour = film.colours[n];
      const trail = [];
      for (let k = Math.max(0, i - Math.round(4 / one.step)); k <= i; k++) {
        const old = one.p[k].slice(4 * n, 4 * n + 3);
        if (old[0] !== null) trail.push(at(old[0] / 1e3, old[1] / 1e3, old[2] / 1e3));
      }
      pen.globalAlpha = 0.35; stroke(trail, shade(colour, 1), 1.5); pen.globalAlpha = 1;
      things.push([at(p[0], p[1], p[2])[2], () => {
        if (p[2] > 0.05) stroke([at(p[0], p[1], 0), at(p[0], p[1], p[2])], colours.grid, 1);
        const ring = Array.from({ length: SIDES }, (_, k) => {
          const angle = (2 * Math.PI * k) / SIDES;
          return [p[0] + r * Math.cos(angle), p[1] + r * Math.sin(angle)];
        });
        prism(at, ring, p[2], top, colour, 0.95);
        stroke([at(p[0], p[1], top), at(p[0] + 1.5 * r * Math.cos(p[3]), p[1] + 1.5 * r * Math.sin(p[3]), top)],
          colours.text, 1.5);
        if (film.names.length > 24) return;
        const [x, y] = at(p[0], p[1], top + 0.05);
        pen.fillStyle = colours.text; pen.textAlign = "center"; pen.fillText(film.names[n], x, y);
      }]);
    });
    things.sort((a, b) => b[0] - a[0]).forEach((each) => each[1]());
    pen.fillStyle = colours.text; pen.textAlign = "left"; pen.fillText(one.name, left + 8, 16);
    pen.restore();
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, wide = canvas.clientWidth, tall = canvas.clientHeight;
    canvas.width = wide * ratio; canvas.height = tall * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const style = getComputedStyle(root);
    colours = { text: style.color, grid: "rgba(140,144,152,.3)", edge: "rgba(120,124,132,.9)" };
    pen.font = `12px ${style.fontFamily}`;
    const share = wide / film.cases.length;
    film.cases.forEach((one, k) => scene(one, k * share, share, tall));
    slider.value = t; clock.textContent = `${t.toFixed(1)} s`;
    const before = film.events.filter((each) => each[0] <= t);
    said.textContent = before.length ? before[before.length - 1][1] : "";
  }
  function tick(now) {
    if (!playing) return;
    t += ((now - last) / 1e3) * speed.value; last = now;
    if (t >= film.end) { t = film.end; toggle(); }
    draw();
    if (playing) requestAnimationFrame(tick);
  }
  function toggle() {
    playing = !playing; play.textContent = playing ? "Pause" : "Play";
    if (!playing) return;
    if (t >= film.end) t = film.begin;
    last = performance.now(); requestAnimationFrame(tick);
  }
  for (const [when, text] of film.events) {
    const mark = document.createElement("i");
    mark.style.left = `${(100 * (when - film.begin)) / (film.end - film.begin)}%`;
    mark.title = `${when.toFixed(1)} s: ${text}`;
    mark.onclick = () => { t = when; draw(); };
    marks.append(mark);
  }
  [slider.min, slider.max] = [film.begin, film.end];
  slider.oninput = () => { t = Number(slider.value); draw(); };
  play.onclick = toggle;
  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (!event.buttons) return;
    turn += event.movementX / 200; tilt = Math.min(1.55, Math.max(0.05, tilt + event.movementY / 200)); draw();
  };
  canvas.onwheel = (event) => {
    if (!event.ctrlKey && document.activeElement !== canvas) return; // else the page scrolls
    event.preventDefault(); far = Math.min(5 * size, Math.max(0.2 * size, far * Math.exp(event.deltaY / 500))); draw();
  };
  window.addEventListener("resize", draw);
  root.hidden = false;
  t = film.at; draw();
})
