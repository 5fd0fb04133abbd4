"use strict";
(() => {
  // points are drawn by hand, the nearest on top: a few thousand need no graphics card
  const EDGES = [0, 1, 2, 3].flatMap((i) => [[i, (i + 1) % 4], [i + 4, ((i + 1) % 4) + 4], [i, i + 4]]);
  const LARGEST = 16; // pixels of a point
  const FOCAL = 1.3; // of the picture's height
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
  const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

  for (const section of document.querySelectorAll(".in-space")) {
    const figure = section.querySelector("figure");
    const canvas = figure.querySelector("canvas");
    const now = figure.querySelector("input");
    const badges = [...figure.querySelectorAll(".stage .no")];
    const told = JSON.parse(figure.dataset.space);
    const states = told.states.map((s) => ({ xyz: new Uint16Array(bytes(s.xyz).buffer), rgb: bytes(s.rgb) }));
    const { width, height } = canvas;
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const depths = new Float32Array(pixels.length);
    let [turn, pitch, far] = told.from;

    // from a point to its pixel and how far away it is
    const looking = () => {
      const [s, c, sp, cp] = [Math.sin(turn), Math.cos(turn), Math.sin(pitch), Math.cos(pitch)];
      const focal = FOCAL * height;
      return (x, y, z) => {
        const depth = far - (cp * (c * x + s * y) + sp * z);
        const up = cp * z - sp * (c * x + s * y);
        return [width / 2 + (focal * (c * y - s * x)) / depth, height / 2 - (focal * up) / depth, depth];
      };
    };

    const points = (at, { xyz, rgb }) => {
      pixels.fill(0);
      depths.fill(Infinity);
      const place = (v) => ((2 * v) / 65535 - 1) * told.within;
      for (let i = 0; i < xyz.length; i += 3) {
        const [u, v, depth] = at(place(xyz[i]), place(xyz[i + 1]), place(xyz[i + 2]));
        if (depth < 0.1) continue;
        const side = clamp(Math.ceil((told.point * FOCAL * height) / depth), 1, LARGEST);
        const ink = (255 << 24) | (rgb[i + 2] << 16) | (rgb[i + 1] << 8) | rgb[i];
        const [left, top] = [Math.round(u - side / 2), Math.round(v - side / 2)];
        for (let y = Math.max(top, 0); y < Math.min(top + side, height); y++) {
          for (let x = Math.max(left, 0); x < Math.min(left + side, width); x++) {
            if (depth >= depths[y * width + x]) continue;
            depths[y * width + x] = depth;
            pixels[y * width + x] = ink;
          }
        }
      }
      pen.putImageData(image, 0, 0);
    };

    const line = (from, to, ink, dash) => {
      pen.beginPath();
      pen.moveTo(from[0], from[1]);
      pen.lineTo(to[0], to[1]);
      pen.setLineDash(dash);
      for (const [colour, wide] of [["#000a", 5], [ink, 2.5]]) {
        pen.strokeStyle = colour;
        pen.lineWidth = wide;
        pen.stroke();
      }
    };

    const box = (at, corners, ink, dash, badge) => {
      const shown = corners.map((corner) => at(...corner));
      const whole = shown.every(([, , depth]) => depth > 0.1);
      const top = [0, 1, 2].map((k) => shown.slice(4).reduce((sum, corner) => sum + corner[k] / 4, 0));
      const inside = whole && top[0] > 0 && top[0] < width && top[1] > 0 && top[1] < height;
      badge.style.display = inside ? "" : "none";
      badge.style.left = (100 * top[0]) / width + "%";
      badge.style.top = (100 * top[1]) / height + "%";
      if (whole) for (const [a, b] of EDGES) line(shown[a], shown[b], ink, dash);
      return whole ? top : null;
    };

    const show = () => {
      const at = looking();
      points(at, states[now.checked ? 1 : 0]);
      let next = 0;
      for (const [was, is] of told.objects) {
        const from = was && box(at, was, style("--out"), [7, 5], badges[next++]);
        const to = is && box(at, is, style("--in"), [], badges[next++]);
        if (from && to) line(from, to, "#fff", [7, 5]);
      }
    };

    const look = (dx, dy, nearer) => {
      turn -= dx;
      pitch = clamp(pitch + dy, -0.2, 1.5);
      far = clamp(far * nearer, 0.5, 20);
      requestAnimationFrame(show);
    };
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) look(event.movementX / 150, event.movementY / 150, 1);
    });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [0.1, 0, 1], ArrowRight: [-0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1] };
      const step = { ...steps, "+": [0, 0, 0.85], "=": [0, 0, 0.85], "-": [0, 0, 1.18] }[event.key];
      if (!step || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      look(...step);
    });
    // a page that is scrolled goes on, but over a scene that was taken hold of
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      look(0, 0, event.deltaY < 0 ? 0.9 : 1.11);
    });
    now.addEventListener("input", show);
    section.hidden = false;
    show();
  }
})();
