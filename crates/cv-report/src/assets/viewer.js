// A small viewer for colored points and camera frusta: WebGL 2, no other file, no network.
(() => {
  const VERTEX = `#version 300 es
    in vec3 p; in vec3 c; uniform mat4 m; uniform vec3 low, box; uniform float size; out vec4 color;
    void main() { gl_Position = m * vec4(low + box * p, 1.0); gl_PointSize = max(1.0, size / gl_Position.w); color = vec4(c, 1.0); }`;
  const FRAGMENT = `#version 300 es
    precision mediump float; in vec4 color; uniform bool round, ring; out vec4 o;
    void main() {
      float r = length(gl_PointCoord - 0.5);
      if (round && r > 0.5 || ring && r < 0.3) discard;
      o = ring ? vec4(1.0, 0.95, 0.2, 1.0) : color;
    }`;
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const add = (a, b, s) => a.map((v, i) => v + s * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };

  function start(figure) {
    const scene = JSON.parse(figure.dataset.scene);
    figure.removeAttribute("data-scene");
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl2", { antialias: true, powerPreference: "high-performance" });
    if (!gl) return;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "Point cloud: drag to turn, wheel to zoom, click a point for its pixels");
    const still = figure.querySelector(".still");
    if (still) still.style.display = "none";
    figure.prepend(canvas);

    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "p");
    gl.bindAttribLocation(program, 1, "c");
    gl.linkProgram(program);
    gl.useProgram(program);
    const at = (name) => gl.getUniformLocation(program, name);
    const where = Object.fromEntries(["m", "low", "box", "size", "round", "ring"].map((name) => [name, at(name)]));
    // A vertex array with positions of the given type, and colors.
    const upload = (places, type, colors) => {
      const vao = gl.createVertexArray();
      gl.bindVertexArray(vao);
      [[places, type, type !== gl.FLOAT], [bytes(colors), gl.UNSIGNED_BYTE, true]].forEach(([data, type, normalized], i) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        gl.enableVertexAttribArray(i);
        gl.vertexAttribPointer(i, 3, type, normalized, 0, 0);
      });
      return vao;
    };
    const shorts = new Uint16Array(bytes(scene.positions).buffer), ends = new Float32Array(bytes(scene.ends).buffer);
    const sightings = new Uint16Array(bytes(scene.sightings).buffer);
    const points = upload(shorts, gl.UNSIGNED_SHORT, scene.colors);
    const lines = upload(ends, gl.FLOAT, scene.lineColors);
    const place = (i) => scene.low.map((low, axis) => low + scene.size[axis] * shorts[3 * i + axis] / 65535);

    // The eye is at `distance` from `target`, rotated by yaw and pitch. The world's y points down.
    const view = {}, f = 2.2;
    // Point size: large for few points, small for many.
    let size = Math.max(1.6, Math.min(3, 260 / Math.sqrt(scene.count || 1))), showCameras = true, chosen = -1;
    function aim() {
      const axis = scene.axis || [0, 0, 1];
      view.yaw = Math.atan2(axis[0], axis[2]) + 0.3;
      view.pitch = Math.max(-1.2, Math.min(1.2, Math.atan2(axis[1], Math.hypot(axis[0], axis[2])) + 0.3));
    }
    // Computes the nearest view that contains every camera and all but the outermost points: first the distance from the target, then the target
    // that equalizes the margins. A point at (u, v, w) from the center along the view's axes is inside a view of half width k where
    // |u - shift| <= k (w + distance).
    function frame() {
      const axes = basis(), step = Math.max(1, Math.floor(scene.count / 2000));
      const along = (p) => axes.map((axis) => dot(axis, add(p, scene.center, -1)));
      const dots = [], corners = [];
      for (let i = 0; i < scene.count; i += step) dots.push(along(place(i)));
      for (let i = 0; i < ends.length; i += 3) corners.push(along([...ends.slice(i, i + 3)]));
      const most = (reach) => {
        const sorted = dots.map(reach).sort((a, b) => a - b);
        const high = sorted.length ? sorted[Math.floor(0.98 * (sorted.length - 1))] : -Infinity;
        return corners.reduce((high, p) => Math.max(high, reach(p)), high);
      };
      const sides = [Math.max(1, canvas.clientWidth) / Math.max(1, canvas.clientHeight), 1].map((side) => 0.92 * side / f);
      const needed = sides.map((k, i) => (most((p) => p[i] - k * p[2]) + most((p) => -p[i] - k * p[2])) / (2 * k));
      const distance = Math.max(...needed);
      view.target = [...scene.center];
      view.distance = distance > 0 && distance < Infinity ? distance : 2 * scene.radius;
      for (const i of [0, 1]) {
        let low = -2 * view.distance, high = 2 * view.distance;
        for (let round = 0; round < 24; round++) {
          const shift = (low + high) / 2, reach = (sign) => (p) => sign * (p[i] - shift) / Math.max(1e-9, p[2] + view.distance);
          if (most(reach(1)) > most(reach(-1))) low = shift;
          else high = shift;
        }
        view.target = add(view.target, axes[i], (low + high) / 2);
      }
    }
    let framed = true;
    function reset() {
      framed = true;
      aim();
      draw();
    }
    function basis() {
      const { yaw, pitch } = view;
      const z = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
      const x = unit(cross([0, 1, 0], z));
      return [x, cross(z, x), z];
    }
    // Projection times view matrix, column-major; y is flipped to point up on the screen.
    function projection(w, h) {
      const [x, y, z] = basis();
      const eye = add(view.target, z, -view.distance);
      const near = view.distance * 0.005, far = view.distance + 60 * scene.radius;
      const a = f * h / w, q = (far + near) / (far - near), r = -2 * far * near / (far - near);
      const t = [x, y, z].map((v) => -dot(v, eye));
      return [
        a * x[0], -f * y[0], q * z[0], z[0],
        a * x[1], -f * y[1], q * z[1], z[1],
        a * x[2], -f * y[2], q * z[2], z[2],
        a * t[0], -f * t[1], q * t[2] + r, t[2],
      ];
    }
    let pending = false;
    function draw() {
      if (pending) return;
      pending = true;
      requestAnimationFrame(() => {
        pending = false;
        const scale = Math.min(window.devicePixelRatio || 1, 2);
        const w = Math.max(1, Math.round(canvas.clientWidth * scale)), h = Math.max(1, Math.round(canvas.clientHeight * scale));
        if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
        // Until the user moves it, the view is fitted to the window.
        if (framed) frame();
        gl.viewport(0, 0, w, h);
        gl.clearColor(0.078, 0.086, 0.11, 1);
        gl.enable(gl.DEPTH_TEST);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
        gl.uniformMatrix4fv(where.m, false, projection(w, h));
        gl.uniform3fv(where.low, scene.low);
        gl.uniform3fv(where.box, scene.size);
        // At the reference distance a point has the size of the slider; nearer ones are larger.
        gl.uniform1f(where.size, size * scale * view.distance);
        gl.uniform1i(where.round, 1);
        gl.bindVertexArray(points);
        gl.drawArrays(gl.POINTS, 0, scene.count);
        if (chosen >= 0) {
          gl.disable(gl.DEPTH_TEST);
          gl.uniform1i(where.ring, 1);
          gl.uniform1f(where.size, 18 * scale * depth(place(chosen)));
          gl.drawArrays(gl.POINTS, chosen, 1);
          gl.uniform1i(where.ring, 0);
        }
        if (showCameras && ends.length) {
          gl.uniform3fv(where.low, [0, 0, 0]);
          gl.uniform3fv(where.box, [1, 1, 1]);
          gl.uniform1i(where.round, 0);
          gl.bindVertexArray(lines);
          gl.drawArrays(gl.LINES, 0, ends.length / 3);
        }
      });
    }
    const depth = (p) => dot(basis()[2], add(p, view.target, -1)) + view.distance;

    // Picks the point at a canvas position: among those within a finger's width, near to the eye and to the position.
    function pick(x, y) {
      const w = canvas.clientWidth, h = canvas.clientHeight, m = projection(w, h);
      let best = -1, least = Infinity;
      const row = (k, x, y, z) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k];
      const [lx, ly, lz] = scene.low, [sx, sy, sz] = scene.size.map((v) => v / 65535);
      for (let i = 0; i < scene.count; i++) {
        const px = lx + sx * shorts[3 * i], py = ly + sy * shorts[3 * i + 1], pz = lz + sz * shorts[3 * i + 2];
        const d = row(3, px, py, pz);
        if (d <= 0.005 * view.distance) continue;
        const dx = (row(0, px, py, pz) / d + 1) * w / 2 - x, dy = (1 - row(1, px, py, pz) / d) * h / 2 - y;
        const away = Math.sqrt(dx * dx + dy * dy), cost = away + 30 * d / view.distance;
        if (away < 14 && cost < least) [best, least] = [i, cost];
      }
      choose(best);
    }
    function choose(i) {
      chosen = i;
      const pixel = (v, side) => (v * side / 65534 - 0.5).toFixed(1);
      const seen = scene.photos.flatMap(({ name, side }, k) => {
        const [x, y] = sightings.subarray(2 * (i * scene.photos.length + k));
        return i < 0 || x === 65535 ? [] : [`${name}: x ${pixel(x, side)}, y ${pixel(y, side)} px`];
      });
      const at = i < 0 ? "" : `at (${place(i).map((v) => v.toPrecision(4)).join(", ")})`;
      told.textContent = i < 0 ? "" : [...seen, at].join(" · ");
      told.hidden = i < 0;
      draw();
    }

    const turn = (dx, dy) => {
      framed = false;
      view.yaw += dx * 0.006;
      view.pitch = Math.max(-1.55, Math.min(1.55, view.pitch + dy * 0.006));
    };
    const pan = (dx, dy) => {
      framed = false;
      const [x, y] = basis(), s = 2 * view.distance / (f * canvas.clientHeight);
      view.target = add(add(view.target, x, -dx * s), y, -dy * s);
    };
    const zoom = (factor) => {
      framed = false;
      view.distance = Math.max(0.01 * scene.radius, Math.min(60 * scene.radius, view.distance * factor));
    };
    const fingers = new Map();
    let press = null;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      press = fingers.size === 1 && e.button === 0 ? [e.clientX, e.clientY] : null;
    });
    canvas.addEventListener("pointerup", (e) => {
      if (!press || Math.hypot(e.clientX - press[0], e.clientY - press[1]) > 5) return;
      const box = canvas.getBoundingClientRect();
      pick(e.clientX - box.left, e.clientY - box.top);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const last = fingers.get(e.pointerId);
      if (!last) return;
      const now = [e.clientX, e.clientY], dx = now[0] - last[0], dy = now[1] - last[1];
      if (fingers.size === 2) {
        const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
        const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
        const after = Math.hypot(now[0] - other[0], now[1] - other[1]);
        if (after > 0) zoom(before / after);
        pan(dx / 2, dy / 2);
      } else if (e.buttons & 6 || e.shiftKey) pan(dx, dy);
      else turn(dx, dy);
      fingers.set(e.pointerId, now);
      draw();
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      zoom(Math.exp(Math.max(-100, Math.min(100, e.deltaY)) * 0.0015));
      draw();
    }, { passive: false });
    canvas.addEventListener("dblclick", reset);
    canvas.addEventListener("keydown", (e) => {
      const step = 12;
      const moves = {
        ArrowLeft: () => turn(step, 0), ArrowRight: () => turn(-step, 0), ArrowUp: () => turn(0, step), ArrowDown: () => turn(0, -step),
        "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1), r: reset,
      };
      if (!moves[e.key]) return;
      e.preventDefault();
      moves[e.key]();
      draw();
    });

    const bar = document.createElement("div");
    bar.className = "bar";
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "Reset view";
    button.addEventListener("click", reset);
    const labeled = (text, type, set) => {
      const label = document.createElement("label"), input = document.createElement("input");
      input.type = type;
      set(input);
      input.addEventListener("input", draw);
      label.append(text, input);
      return label;
    };
    bar.append(button, labeled("Point size", "range", (i) => {
      [i.min, i.max, i.step, i.value] = [0.5, 10, 0.1, size];
      i.addEventListener("input", () => { size = Number(i.value); });
    }));
    if (ends.length) bar.append(labeled("Cameras", "checkbox", (i) => {
      i.checked = true;
      i.addEventListener("input", () => { showCameras = i.checked; });
    }));
    const help = document.createElement("span");
    help.textContent = `${scene.count.toLocaleString("en")} points · drag turns, right drag or two fingers move, wheel zooms${scene.photos.length ? ", a click on a point tells where it was seen" : ""}`;
    bar.append(help);
    const told = document.createElement("p");
    told.className = "told";
    told.hidden = true;
    told.setAttribute("aria-live", "polite");
    canvas.after(told, bar);
    new ResizeObserver(draw).observe(canvas);
    reset();
  }
  document.querySelectorAll("figure.cloud").forEach((figure) => {
    try { start(figure); } catch (error) { console.error(error); }
  });
})();
