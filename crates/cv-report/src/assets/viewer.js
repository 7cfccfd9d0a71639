// A small viewer for colored points and camera outlines: WebGL 2, no other file, no network.
(() => {
  const VERTEX = `#version 300 es
    in vec3 p; in vec4 c; uniform mat4 m; uniform float size; out vec4 color;
    void main() { gl_Position = m * vec4(p, 1.0); gl_PointSize = max(1.0, size / gl_Position.w); color = c; }`;
  const FRAGMENT = `#version 300 es
    precision mediump float; in vec4 color; uniform bool round; out vec4 o;
    void main() { if (round && length(gl_PointCoord - 0.5) > 0.5) discard; o = color; }`;
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const sub = (a, b) => a.map((v, i) => v - b[i]);
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
    canvas.setAttribute("aria-label", "Point cloud: drag to turn, wheel to zoom");
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
    const where = { m: at("m"), size: at("size"), round: at("round") };
    const upload = (text) => {
      const data = bytes(text);
      const vao = gl.createVertexArray();
      gl.bindVertexArray(vao);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 16, 0);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 16, 12);
      return { vao, count: data.length / 16 };
    };
    const points = upload(scene.points);
    const lines = upload(scene.lines);

    // The eye is at `distance` from `target`, turned by yaw and pitch. The world's y points down.
    const view = {};
    let size = 2.5, showCameras = true;
    function reset() {
      const back = scene.eye ? sub(scene.center, scene.eye) : [0, 0, 1];
      view.target = [...scene.center];
      const depth = Math.hypot(...back);
      view.distance = scene.eye && depth > 0.5 * scene.radius ? Math.min(depth * 1.25, 6 * scene.radius) : 2 * scene.radius;
      view.yaw = Math.atan2(back[0], back[2]) + 0.15;
      view.pitch = Math.atan2(back[1], Math.hypot(back[0], back[2])) + 0.12;
      draw();
    }
    function basis() {
      const { yaw, pitch } = view;
      const z = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
      const x = unit(cross([0, 1, 0], z));
      return [x, cross(z, x), z];
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
        gl.viewport(0, 0, w, h);
        gl.clearColor(0.078, 0.086, 0.11, 1);
        gl.enable(gl.DEPTH_TEST);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
        const [x, y, z] = basis();
        const eye = add(view.target, z, -view.distance);
        const f = 1.7, near = view.distance * 0.005, far = view.distance + 60 * scene.radius;
        const a = f * h / w, q = (far + near) / (far - near), r = -2 * far * near / (far - near);
        const t = [x, y, z].map((v) => -dot(v, eye));
        // Columns of the projection times the motion; y is turned to point up on the screen.
        gl.uniformMatrix4fv(where.m, false, [
          a * x[0], -f * y[0], q * z[0], z[0],
          a * x[1], -f * y[1], q * z[1], z[1],
          a * x[2], -f * y[2], q * z[2], z[2],
          a * t[0], -f * t[1], q * t[2] + r, t[2],
        ]);
        // At the reference distance a point has the size of the slider, nearer ones are larger.
        gl.uniform1f(where.size, size * scale * view.distance);
        gl.uniform1i(where.round, 1);
        gl.bindVertexArray(points.vao);
        gl.drawArrays(gl.POINTS, 0, points.count);
        if (showCameras && lines.count) {
          gl.uniform1i(where.round, 0);
          gl.bindVertexArray(lines.vao);
          gl.drawArrays(gl.LINES, 0, lines.count);
        }
      });
    }

    const turn = (dx, dy) => {
      view.yaw += dx * 0.006;
      view.pitch = Math.max(-1.55, Math.min(1.55, view.pitch + dy * 0.006));
    };
    const pan = (dx, dy) => {
      const [x, y] = basis(), s = view.distance / (0.85 * canvas.clientHeight);
      view.target = add(add(view.target, x, -dx * s), y, -dy * s);
    };
    const zoom = (factor) => {
      view.distance = Math.max(0.01 * scene.radius, Math.min(60 * scene.radius, view.distance * factor));
    };
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
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
    if (lines.count) bar.append(labeled("Cameras", "checkbox", (i) => {
      i.checked = true;
      i.addEventListener("input", () => { showCameras = i.checked; });
    }));
    const help = document.createElement("span");
    help.textContent = `${scene.count.toLocaleString("en")} points · drag turns, right drag moves, wheel zooms`;
    bar.append(help);
    canvas.after(bar);
    new ResizeObserver(draw).observe(canvas);
    reset();
  }
  document.querySelectorAll("figure.cloud").forEach((figure) => {
    try { start(figure); } catch (error) { console.error(error); }
  });
})();
