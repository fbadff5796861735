// The flight in the tank, drawn on a 2D canvas. World NED; drawn with north x, west -y, up -z, which keeps handedness.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("flight").textContent);
  const byId = (name) => document.getElementById(name);
  const stage = byId("stage"), timeline = byId("timeline");
  const METRES_PER_NEWTON = 0.08;  // length of a thruster's arrow
  const SMALLEST_ARROW_N = 0.05;
  const HOME = { azimuth: 0.58, elevation: 0.40, zoom: 1 };
  const low = data.tank.low, high = data.tank.high;
  const centre = low.map((value, i) => (value + high[i]) / 2);
  const size = Math.hypot(...low.map((value, i) => high[i] - value));
  const end = data.t[data.t.length - 1];
  const worst = Math.max(...data.error_mm.filter((_, i) => data.t[i] >= data.window[0] && data.t[i] <= data.window[1]), 1);
  const state = { t: 0, playing: true, speed: 4, magnify: 1, last: 0, ...HOME };

  // ---------------------------------------------------------------- vectors and the camera

  const turn = (q, v) => {
    const [w, x, y, z] = q;
    const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
    return [
      v[0] + w * t[0] + y * t[2] - z * t[1],
      v[1] + w * t[1] + z * t[0] - x * t[2],
      v[2] + w * t[2] + x * t[1] - y * t[0],
    ];
  };
  const times = (a, b) => [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
  const inverse = (q) => [q[0], -q[1], -q[2], -q[3]];
  const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
  const between = (a, b, s) => a.map((value, i) => value + s * (b[i] - value));
  const slerp = (a, b, s) => {
    const dot = a.reduce((sum, value, i) => sum + value * b[i], 0);
    const q = between(a, dot < 0 ? b.map((value) => -value) : b, s);
    const length = Math.hypot(...q);
    return q.map((value) => value / length);
  };

  let width = 0, height = 0;
  const project = (p) => {
    const x = p[0] - centre[0], y = -(p[1] - centre[1]), z = -(p[2] - centre[2]);
    const ca = Math.cos(state.azimuth), sa = Math.sin(state.azimuth);
    const ce = Math.cos(state.elevation), se = Math.sin(state.elevation);
    const right = ca * x + sa * y, forward = -sa * x + ca * y;
    const depth = forward * ce - z * se + 2.1 * size;
    const k = 2.3 * state.zoom * Math.min(height, 0.8 * width) / depth;
    return [width / 2 + k * right, height * 0.52 - k * (forward * se + z * ce), depth];
  };

  // ---------------------------------------------------------------- the flight at a time

  const indexAt = (t) => {
    let a = 0, b = data.t.length - 1;
    while (b - a > 1) {
      const middle = (a + b) >> 1;
      if (data.t[middle] <= t) a = middle; else b = middle;
    }
    return a;
  };
  const judged = (i) => data.t[i] >= data.window[0] && data.t[i] <= data.window[1] && data.error_mm[i] !== null;
  const cuts = new Set(data.cuts);  // modules joined or parted: what is followed is another point, and its line begins anew
  const cut = (p, i) => (cuts.has(i) ? [null, p] : [p]);
  const reference = data.ref_p.flatMap((p, i) => (judged(i) ? cut(p, i) : []));  // before the task there may be none yet
  const magnified = (i) => (judged(i) ? between(data.ref_p[i], data.p[i], state.magnify) : data.p[i]);
  const guests = [...data.modules.keys()].filter((m) => data.modules[m].member.includes(0));  // not in the body all the time
  const moduleAt = (m, i) => {  // the body's error moves all of its modules, and no other
    const p = data.modules[m].p[i];
    return judged(i) && data.modules[m].member[i] ? add(p, add(data.p[i], data.ref_p[i], -1), state.magnify - 1) : p;
  };
  const sample = (t) => {
    const i = indexAt(t), j = Math.min(i + 1, data.t.length - 1);
    const s = j > i ? Math.min(1, (t - data.t[i]) / (data.t[j] - data.t[i])) : 0;
    const known = (name) => (data[name][i] === null || data[name][j] === null ? null : data[name][i] + s * (data[name][j] - data[name][i]));
    const mix = (name) => between(data[name][i], data[name][j], s);
    return {
      i, p: between(magnified(i), magnified(j), s), q: slerp(data.q[i], data.q[j], s), truth: mix("p"),
      refP: mix("ref_p"), refQ: slerp(data.ref_q[i], data.ref_q[j], s),
      modules: data.modules.map((module, m) => ({
        member: module.member[i], faces: faces[m], thrusters: module.thrusters, force: between(module.force[i], module.force[j], s),
        p: between(moduleAt(m, i), moduleAt(m, j), s), q: slerp(module.q[i], module.q[j], s),
      })),
      error: known("error_mm"), angle: known("angle_deg"),  // null until the firmware knows its pose
    };
  };

  // ---------------------------------------------------------------- drawing

  let g = stage.getContext("2d");
  const path = (points, colour, thickness, dash = []) => {
    g.beginPath();
    points.forEach((p, i) => {  // a line begins after each null
      if (!p) return;
      const [x, y] = project(p);
      if (i && points[i - 1]) g.lineTo(x, y); else g.moveTo(x, y);
    });
    g.strokeStyle = colour; g.lineWidth = thickness; g.setLineDash(dash); g.lineJoin = g.lineCap = "round";
    g.stroke(); g.setLineDash([]);
  };
  const polygon = (points, fill, edge) => {
    g.beginPath();
    points.forEach((p, i) => { const [x, y] = project(p); if (i) g.lineTo(x, y); else g.moveTo(x, y); });
    g.closePath();
    if (fill) { g.fillStyle = fill; g.fill(); }
    if (edge) { g.strokeStyle = edge; g.lineWidth = 1.2; g.lineJoin = "round"; g.stroke(); }
  };
  const text = (p, words, shift = [0, 0]) => {
    const [x, y] = project(p);
    g.fillStyle = "rgba(207,224,239,0.85)"; g.font = "12px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
    g.fillText(words, x + shift[0], y + shift[1]);
  };

  const ring = (z) => {
    const points = [];
    if (data.tank.kind === "cylinder") {
      for (let i = 0; i <= 72; i++) {
        const angle = i * Math.PI / 36;
        points.push([centre[0] + (high[0] - centre[0]) * Math.cos(angle), centre[1] + (high[1] - centre[1]) * Math.sin(angle), z]);
      }
    } else {
      points.push([low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z], [low[0], low[1], z]);
    }
    return points;
  };
  const drawTank = () => {
    polygon(ring(high[2]), "rgba(255,255,255,0.05)");
    const step = (high[0] - low[0]) > 4 ? 1 : 0.2;
    if (data.tank.kind === "box") {
      for (let x = Math.ceil(low[0] / step) * step; x <= high[0]; x += step) {
        path([[x, low[1], high[2]], [x, high[1], high[2]]], "rgba(255,255,255,0.10)", 1);
      }
      for (let y = Math.ceil(low[1] / step) * step; y <= high[1]; y += step) {
        path([[low[0], y, high[2]], [high[0], y, high[2]]], "rgba(255,255,255,0.10)", 1);
      }
      for (const [x, y] of [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]) {
        path([[x, y, low[2]], [x, y, high[2]]], "rgba(160,200,235,0.45)", 1);
      }
    }
    path(ring(high[2]), "rgba(160,200,235,0.55)", 1);
    const metres = (a, b) => `${(b - a).toFixed(2)} m`;
    const nearY = project([centre[0], low[1], high[2]])[2] < project([centre[0], high[1], high[2]])[2] ? low[1] : high[1];
    const nearX = project([low[0], centre[1], high[2]])[2] < project([high[0], centre[1], high[2]])[2] ? low[0] : high[0];
    const label = (p, words) => text(p, words, [project(p)[0] < width / 2 ? -48 : 48, 16]);
    label([centre[0], nearY, high[2]], `north, ${metres(low[0], high[0])}`);
    label([nearX, centre[1], high[2]], `east, ${metres(low[1], high[1])}`);
  };
  const drawSurface = () => {
    polygon(ring(low[2]), "rgba(120,190,240,0.07)");
    path(ring(low[2]), "rgba(160,210,250,0.75)", 1.2);
    const corners = ring(low[2]).map((p) => [p, project(p)]);
    const left = corners.reduce((a, b) => (b[1][0] < a[1][0] ? b : a));
    text(left[0], "surface", [-30, -8]);
  };

  const facesOf = (half) => [[0, 1], [0, -1], [1, 1], [1, -1], [2, 1], [2, -1]].map(([axis, sign]) => {
    const a = (axis + 1) % 3, b = (axis + 2) % 3;
    const corners = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([u, v]) => {
      const corner = [0, 0, 0];
      corner[axis] = sign * half[axis]; corner[a] = u * half[a]; corner[b] = v * half[b];
      return corner;
    });
    const normal = [0, 0, 0], middle = [0, 0, 0];
    normal[axis] = sign; middle[axis] = sign * half[axis];
    return { corners, normal, middle, top: axis === 2 && sign < 0, front: axis === 0 && sign > 0 };
  });
  const faces = data.modules.map((module) => facesOf(module.hull.map((value) => value / 2)));
  const drawHulls = (modules) => {
    const eye = modules.flatMap(({ p, q, faces }) => faces.map((face) => {
      const corners = face.corners.map((corner) => add(p, turn(q, corner)));
      const middle = add(p, turn(q, face.middle)), depth = project(middle)[2];
      return { q, face, corners, middle, depth, near: depth - project(p)[2] };
    }));
    eye.sort((a, b) => b.depth - a.depth);
    for (const { q, face, corners, middle, near } of eye) {
      const light = 0.62 - 0.30 * turn(q, face.normal)[2];  // from above
      const base = face.front ? [255, 196, 92] : [122, 180, 226];
      const colour = base.map((value) => Math.round(value * Math.min(1, light))).join(",");
      polygon(corners, `rgba(${colour},${near < 0 ? 0.62 : 0.35})`, "rgba(235,245,255,0.85)");
      if (face.top && near < 0) {  // the tag
        polygon(corners.map((corner) => between(middle, corner, 0.45)), "rgba(12,24,38,0.8)", "rgba(255,255,255,0.9)");
      }
    }
  };
  const drawGhost = (now) => {  // the body's modules where they would be without its error
    const back = times(now.refQ, inverse(now.q));
    for (const { p, q, faces } of now.modules.filter((module) => module.member)) {
      const place = add(now.refP, turn(back, add(p, now.p, -1))), attitude = times(back, q);
      for (const face of faces) {
        const corners = face.corners.map((corner) => add(place, turn(attitude, corner)));
        path([...corners, corners[0]], "rgba(255,255,255,0.35)", 1, [3, 4]);
      }
    }
  };
  const drawArrows = ({ p, q, thrusters, force }) => {
    thrusters.p.forEach((position, i) => {
      const newton = force[i];
      const [x, y] = project(add(p, turn(q, position)));
      g.beginPath(); g.arc(x, y, 2.6, 0, 7); g.fillStyle = "rgba(255,255,255,0.9)"; g.fill();
      if (newton === undefined || Math.abs(newton) < SMALLEST_ARROW_N) return;
      const from = add(p, turn(q, position));
      const to = add(from, turn(q, thrusters.d[i]), newton * METRES_PER_NEWTON);
      const colour = newton > 0 ? "#5fe0a6" : "#ffb454";
      path([from, to], colour, 2.6);
      const [x0, y0] = project(from), [x1, y1] = project(to);
      const angle = Math.atan2(y1 - y0, x1 - x0), tip = Math.min(8, 0.8 * Math.hypot(x1 - x0, y1 - y0));
      g.beginPath();
      g.moveTo(x1 + 2 * Math.cos(angle), y1 + 2 * Math.sin(angle));
      for (const side of [-0.5, 0.5]) g.lineTo(x1 - tip * Math.cos(angle + side), y1 - tip * Math.sin(angle + side));
      g.closePath(); g.fillStyle = colour; g.fill();
    });
  };

  const drawStage = (now) => {
    g = stage.getContext("2d");
    g.clearRect(0, 0, width, height);
    drawTank();
    const trail = [];
    for (let i = 0; i <= now.i; i++) trail.push(...cut(magnified(i), i));
    trail.push(now.p);
    const others = guests.map((m) => {
      const { p, member } = data.modules[m];
      return [...p.slice(0, now.i + 1).map((at, i) => (member[i] ? null : at)), now.modules[m].member ? null : now.modules[m].p];
    });
    path([now.p, [now.p[0], now.p[1], high[2]]], "rgba(255,255,255,0.25)", 1, [2, 4]);
    for (const { p, q, faces } of now.modules) {
      polygon(faces[4].corners.map((corner) => { const c = add(p, turn(q, corner)); return [c[0], c[1], high[2]]; }), "rgba(3,12,22,0.35)");
    }
    path(reference, "rgba(255,255,255,0.75)", 1.4, [6, 6]);
    path(trail, "rgba(88,183,255,0.25)", 6);
    path(trail, "#58b7ff", 2.2);
    for (const other of others) path(other, "rgba(88,183,255,0.6)", 1.2);
    if (state.magnify > 1 && judged(now.i)) drawGhost(now);
    drawHulls(now.modules);
    now.modules.forEach(drawArrows);
    drawSurface();
  };

  const drawTimeline = (now) => {
    const w = timeline.clientWidth, h = timeline.clientHeight, pad = { left: 62, right: 18, top: 10, bottom: 22 };
    const top = 1.15 * worst;
    const x = (t) => pad.left + (w - pad.left - pad.right) * t / end;
    const y = (mm) => h - pad.bottom - (h - pad.top - pad.bottom) * Math.min(mm, top) / top;
    g = timeline.getContext("2d");
    g.clearRect(0, 0, w, h);
    g.fillStyle = "rgba(255,255,255,0.06)";
    g.fillRect(x(data.window[0]), pad.top, x(data.window[1]) - x(data.window[0]), h - pad.top - pad.bottom);
    g.beginPath();
    data.error_mm.forEach((mm, i) => {
      if (mm === null) return;
      if (i && data.error_mm[i - 1] !== null) g.lineTo(x(data.t[i]), y(mm)); else g.moveTo(x(data.t[i]), y(mm));
    });
    g.strokeStyle = "#58b7ff"; g.lineWidth = 1.2; g.lineJoin = "round"; g.stroke();
    g.strokeStyle = "rgba(255,255,255,0.3)"; g.lineWidth = 1;
    g.beginPath(); g.moveTo(pad.left, y(0)); g.lineTo(w - pad.right, y(0)); g.stroke();
    g.fillStyle = "#cfe0ef"; g.font = "11px system-ui, sans-serif"; g.textBaseline = "middle"; g.textAlign = "right";
    g.fillText("0", pad.left - 6, y(0));
    g.fillText(`${worst.toFixed(1)} mm`, pad.left - 6, y(worst));
    g.fillText("error", pad.left - 6, (y(0) + y(worst)) / 2);
    g.textAlign = "center";
    const step = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600].find((each) => end / each <= 12) || 1200;
    for (let t = 0; t < end - 0.3 * step; t += step) g.fillText(`${t}`, x(t), h - 10);
    g.textAlign = "right"; g.fillText(`${end.toFixed(0)} s`, w - pad.right + 8, h - 10);
    g.strokeStyle = "#ffffff"; g.lineWidth = 1.5;
    g.beginPath(); g.moveTo(x(state.t), pad.top - 4); g.lineTo(x(state.t), h - pad.bottom); g.stroke();
    if (now.error === null) return;
    g.beginPath(); g.arc(x(state.t), y(now.error), 3.5, 0, 7); g.fillStyle = "#ffffff"; g.fill();
  };

  const draw = () => {
    const now = sample(state.t);
    drawStage(now);
    drawTimeline(now);
    byId("hud-time").textContent = `${state.t.toFixed(1)} s`;
    byId("hud-error").textContent = now.error === null ? "no pose yet" : `${now.error.toFixed(1)} mm`;
    byId("hud-angle").textContent = now.angle === null ? "no pose yet" : `${now.angle.toFixed(2)} deg`;
    byId("hud-depth").textContent = `${now.truth[2].toFixed(3)} m`;
    const apart = now.modules.every((module) => module.member) ? "" : "; other bodies are drawn as they are";
    const scale = `the error is drawn ${state.magnify} times its size; dashed: reference${apart}`;
    byId("hud-scale").textContent = state.magnify > 1 ? scale : "";
    byId("scrub").value = String(Math.round(1000 * state.t / end));
    byId("play").textContent = state.playing ? "Pause" : "Play";
  };

  // ---------------------------------------------------------------- controls

  const fit = () => {
    const ratio = window.devicePixelRatio || 1;
    for (const canvas of [stage, timeline]) {
      canvas.width = Math.round(canvas.clientWidth * ratio);
      canvas.height = Math.round(canvas.clientHeight * ratio);
      canvas.getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    width = stage.clientWidth; height = stage.clientHeight;
    draw();
  };
  const seek = (t) => { state.t = Math.max(0, Math.min(end, t)); draw(); };
  const toggle = () => {
    state.playing = !state.playing;
    if (state.playing && state.t >= end) state.t = 0;
    draw();
  };
  const frame = (now) => {
    if (state.playing) {
      state.t += state.speed * Math.min(0.1, (now - (state.last || now)) / 1000);
      if (state.t >= end) { state.t = end; state.playing = false; }
      draw();
    }
    state.last = now;
    requestAnimationFrame(frame);
  };

  byId("play").addEventListener("click", toggle);
  byId("scrub").addEventListener("input", (event) => seek(end * event.target.value / 1000));
  byId("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
  byId("magnify").addEventListener("change", (event) => { state.magnify = Number(event.target.value); draw(); });
  byId("view").addEventListener("click", () => { Object.assign(state, HOME); draw(); });
  stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); stage.classList.add("held"); });
  stage.addEventListener("pointerup", () => stage.classList.remove("held"));
  stage.addEventListener("pointermove", (event) => {
    if (!stage.classList.contains("held")) return;
    state.azimuth += 0.008 * event.movementX;
    state.elevation = Math.max(-0.2, Math.min(1.55, state.elevation + 0.008 * event.movementY));
    draw();
  });
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    state.zoom = Math.max(0.4, Math.min(6, state.zoom * Math.exp(-0.0012 * event.deltaY)));
    draw();
  }, { passive: false });
  const seekTo = (event) => seek(end * (event.offsetX - 62) / (timeline.clientWidth - 80));
  timeline.addEventListener("pointerdown", (event) => { timeline.setPointerCapture(event.pointerId); seekTo(event); });
  timeline.addEventListener("pointermove", (event) => { if (event.buttons) seekTo(event); });
  document.addEventListener("keydown", (event) => {
    if (/^(INPUT|SELECT|BUTTON)$/.test(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); toggle(); }
    if (event.key === "ArrowRight") seek(state.t + 0.2);
    if (event.key === "ArrowLeft") seek(state.t - 0.2);
  });
  const still = /^#t=([\d.]+)$/.exec(location.hash);  // report.html#t=20 opens paused there: for pictures
  if (still) { state.t = Math.min(end, Number(still[1])); state.playing = false; }
  new ResizeObserver(fit).observe(stage);
  fit();
  requestAnimationFrame(frame);
})();
