// The view bar over viser's 3D view: standard views, fit, orthographic, a scale bar in mm and the directions of the axes.
// Each browser moves its own camera. Directions are those of the rig's camera: x to the right, y down, z away from it.
(() => {
  const FROM = {
    Front: [0, 0, -1],
    Back: [0, 0, 1],
    Left: [-1, 0, 0],
    Right: [1, 0, 0],
    Top: [0, -1, -1e-3], // tilted a little, so that what is far away is at the top
    Bottom: [0, 1, -1e-3],
  };
  const PARALLEL_DEG = 0.5; // a far camera with a narrow view: sizes differ by 0.2 % over a tenth of a metre of depth
  const NEAR_MM = 5;
  const PARALLEL_NEAR_MM = 50;
  const SCALE_PX = 130;
  const CONTENT = [/^(PointCloud|Mesh|Glb)Message$/, /^(Image|CameraFrustum)Message$/]; // the former, if there are any
  const STYLE = `
    #view-bar, #view-scale { position: fixed; z-index: 5; font: 12px/1 system-ui, sans-serif; color: var(--mantine-color-text, #222); }
    #view-bar { display: flex; border-radius: 5px; overflow: hidden; border: 1px solid var(--mantine-color-default-border, #ccc); }
    #view-bar[hidden] { display: none; }
    #view-bar button { font: inherit; color: inherit; padding: 7px 8px; border: 0; cursor: pointer; background: var(--mantine-color-body, #fff); }
    #view-bar button:hover { background: var(--mantine-color-default-hover, #eee); }
    #view-bar button[aria-pressed=true] { background: var(--mantine-primary-color-light, #d0ebff); }
    [data-legend] { position: fixed; z-index: 5; right: var(--bar-right); bottom: calc(var(--bar-bottom) + 38px); width: 260px; padding: 6px 0 2px;
      border-radius: 5px; border: 1px solid var(--mantine-color-default-border, #ccc); background: var(--mantine-color-body, #fff); }
    #view-scale { pointer-events: none; }
    #view-scale hr { margin: 3px 0 0; height: 5px; border: solid currentcolor; border-width: 0 2px 2px; }
    button:has(.tabler-icon-adjustments) { display: none; } /* viser's own settings and its scene as it stores it */
    #view-scale svg { display: block; overflow: visible; margin-bottom: 8px; }`;
  let fovDeg = 0; // of the perspective view

  const viewer = () => window.__viserMutable;
  const make = (parent, kind, fields = {}) => parent.appendChild(Object.assign(document.createElement(kind), fields));
  const isShown = node => !node || (node.visible && isShown(node.parent));

  /** What is in the view, as corners or sampled points in three.js's world. */
  function listPoints() {
    const { nodeRefFromName: nodes } = viewer();
    const messages = window.__viserSceneTree.getState();
    for (const kinds of CONTENT) {
      const points = [];
      for (const [name, node] of Object.entries(nodes)) {
        if (!node || !kinds.test(messages[name]?.message?.type) || !isShown(node)) continue;
        node.updateWorldMatrix(true, true);
        node.traverse(each => {
          const position = each.geometry?.attributes.position;
          if (!position || each.geometry.isInstancedBufferGeometry) return;
          const step = Math.ceil(position.count / 4000);
          for (let i = 0; i < position.count; i += step)
            points.push(node.position.clone().fromBufferAttribute(position, i).applyMatrix4(each.matrixWorld));
        });
      }
      if (points.length) return points;
    }
    return [];
  }

  /** Move the camera, which looks along a direction (from the object to it), so that all that is shown fits. */
  function fit(from) {
    const { camera, cameraControl: control } = viewer();
    const points = listPoints();
    if (!points.length) return;
    const target = control.getTarget(camera.position.clone());
    const back = from ? toThree(from) : camera.position.clone().sub(target);
    back.normalize();
    const right = camera.up.clone().cross(back).normalize();
    const axes = [right, back.clone().cross(right), back];
    const sides = axes.map(axis => {
      const along = points.map(point => point.dot(axis)).sort((a, b) => a - b);
      return [along[Math.floor(0.01 * along.length)], along[Math.ceil(0.99 * along.length) - 1]];
    });
    const middle = axes.reduce((sum, axis, i) => sum.addScaledVector(axis, (sides[i][0] + sides[i][1]) / 2), back.clone().set(0, 0, 0));
    const [width, height, depth] = sides.map(([low, high]) => high - low);
    const half = Math.tan((camera.fov * Math.PI) / 360);
    const away = (1.15 * Math.max(height, width / camera.aspect, 1)) / (2 * half) + depth / 2;
    const position = middle.clone().addScaledVector(back, away);
    control.setLookAt(...position, ...middle, true);
  }

  /** A direction of the rig's camera in three.js's world. */
  function toThree(direction) {
    const { nodeRefFromName: nodes, camera } = viewer();
    return camera.position.clone().set(...direction).transformDirection(nodes[""].matrixWorld);
  }

  /** Show parallel lines as parallel, or perspective again; what is in the middle keeps its size. */
  function setParallel(on) {
    const { camera, cameraControl: control } = viewer();
    const half = () => Math.tan((camera.fov * Math.PI) / 360);
    const target = control.getTarget(camera.position.clone());
    const offset = camera.position.clone().sub(target).multiplyScalar(half());
    if (on) fovDeg = camera.fov;
    Object.assign(camera, { fov: on ? PARALLEL_DEG : fovDeg, near: on ? PARALLEL_NEAR_MM : NEAR_MM, far: 1e6 });
    camera.updateProjectionMatrix();
    viewer().configuredMaxOrbitDistance = 1e6;
    control.setLookAt(...target.clone().add(offset.divideScalar(half())), ...target, false);
  }

  function build() {
    make(document.head, "style", { textContent: STYLE });
    const bar = make(document.body, "div", { id: "view-bar" });
    bar.setAttribute("role", "toolbar");
    bar.setAttribute("aria-label", "View");
    const acts = {};
    const press = (name, key, title, onclick) => {
      acts[key] = onclick;
      return make(bar, "button", { textContent: name, title: `${title} (key: ${key.toUpperCase()})`, onclick });
    };
    press("Fit", "f", "Show all that is in the view", () => fit());
    Object.entries(FROM).forEach(([name, from], i) => press(name, `${i + 1}`, `Look from the ${name.toLowerCase()}`, () => fit(from)));
    const parallel = press("Ortho", "o", "Orthographic: parallel lines stay parallel, sizes do not depend on depth", () => {
      const on = parallel.ariaPressed !== "true";
      parallel.ariaPressed = on;
      setParallel(on);
    });
    parallel.ariaPressed = false;
    addEventListener("keydown", event => {
      const isTyped = event.target.closest?.("input, textarea, select, [contenteditable], [role=dialog]");
      if (!isTyped && !event.ctrlKey && !event.metaKey && !event.altKey) acts[event.key.toLowerCase()]?.();
    });
    const scale = make(document.body, "div", { id: "view-scale" });
    const axes = make(scale, "div");
    const text = make(scale, "span", { title: "Where the view turns about" });
    const line = make(scale, "hr");

    let drawn = "";
    function draw() {
      requestAnimationFrame(draw);
      const { camera, cameraControl: control, canvas, nodeRefFromName: nodes } = viewer() ?? {};
      const box = canvas?.getBoundingClientRect();
      const isReady = control && box.width > 0 && nodes[""];
      bar.hidden = scale.hidden = !isReady;
      if (!isReady) return;
      const distance = camera.position.distanceTo(control.getTarget(camera.position.clone()));
      const key = [box.left, box.top, box.width, box.height, camera.fov, distance, ...camera.quaternion].join();
      if (key === drawn) return;
      drawn = key;
      const { style } = document.documentElement;
      style.setProperty("--bar-right", `${innerWidth - box.right + 10}px`);
      style.setProperty("--bar-bottom", `${innerHeight - box.bottom + 10}px`);
      Object.assign(bar.style, { right: "var(--bar-right)", bottom: "var(--bar-bottom)" });
      Object.assign(scale.style, { left: `${box.left + 14}px`, bottom: `${innerHeight - box.bottom + (box.width < 520 ? 52 : 14)}px` });
      const mmPerPx = (2 * distance * Math.tan((camera.fov * Math.PI) / 360)) / box.height;
      const decade = 10 ** Math.floor(Math.log10(SCALE_PX * mmPerPx));
      const mm = decade * [5, 2, 1].find(n => n * decade <= SCALE_PX * mmPerPx);
      text.textContent = `${Number(mm.toPrecision(1))} mm`;
      line.style.width = `${mm / mmPerPx}px`;
      const turned = ["x", "y", "z"].map((name, i) => {
        const axis = toThree([0, 0, 0].with(i, 1)).transformDirection(camera.matrixWorldInverse);
        return [name, ["#e03131", "#2f9e44", "#228be6"][i], 24 * axis.x, -24 * axis.y, axis.z];
      });
      axes.innerHTML = `<svg width="64" height="64" viewBox="-32 -32 64 64" role="img" aria-label="Axes">${turned
        .sort((a, b) => a[4] - b[4])
        .map(([name, colour, x, y]) => `<path d="M0 0L${x} ${y}" stroke="${colour}" stroke-width="2"/>
          <text x="${1.3 * x}" y="${1.3 * y + 4}" fill="${colour}" text-anchor="middle">${name}</text>`).join("")}</svg>`;
    }
    draw();
  }
  addEventListener("DOMContentLoaded", build);
})();
