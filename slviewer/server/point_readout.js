// Marks the measured point that a click would pick, with its coordinates in mm, while the pointer moves over viser's 3D view.
// The server says of which objects, in an element of the panel: <i data-hover="/measure/surface">, the start of their names.
(() => {
  const NEAR = 0.01; // distance of a point from the pointer's ray, as a share of its depth; as `nearest` in result_views.py
  const BEHIND = 0.02; // what lies in front comes first
  const FULL_FOV_DEG = 43; // of the view in which NEAR is meant
  const halfTan = deg => Math.tan((deg * Math.PI) / 360);
  let moved; // the latest move of the pointer that is not drawn yet

  /** The point closest to a place of the canvas, {place in mm, in three.js's world}; undefined where there is none. */
  function find(prefix, x, y) {
    const { camera, cameraControl: control, nodeRefFromName: nodes } = window.__viserMutable;
    const [far, size] = [camera.position.clone().set(x, y, 0.5).unproject(camera), halfTan(camera.fov) / halfTan(FULL_FOV_DEG)];
    const direction = far.sub(camera.position).normalize();
    const away = (1 - size) * camera.position.distanceTo(control.getTarget(camera.position.clone()));
    const origin = camera.position.clone().addScaledVector(direction, away);
    let best = { score: Infinity };
    for (const [name, node] of Object.entries(nodes)) {
      if (!node || !name.startsWith(prefix)) continue;
      node.traverseVisible(cloud => {
        if (!cloud.isPoints) return;
        const local = cloud.matrixWorld.clone().invert();
        const from = origin.clone().applyMatrix4(local);
        const to = direction.clone().transformDirection(local);
        const p = cloud.geometry.attributes.position.array;
        for (let i = 0; i < p.length; i += 3) {
          const [a, b, c] = [p[i] - from.x, p[i + 1] - from.y, p[i + 2] - from.z];
          const along = a * to.x + b * to.y + c * to.z;
          if (along <= 0) continue;
          const off = Math.sqrt(Math.max(a * a + b * b + c * c - along * along, 0));
          const score = off + BEHIND * along;
          if (off < NEAR * along && score < best.score) best = { score, mm: [p[i], p[i + 1], p[i + 2]], matrix: cloud.matrixWorld };
        }
      });
    }
    return best.mm && { mm: best.mm, world: camera.position.clone().set(...best.mm).applyMatrix4(best.matrix) };
  }

  function build() {
    const mark = document.body.appendChild(document.createElement("div"));
    mark.id = "point-readout";
    const css = "position:fixed;z-index:6;pointer-events:none;width:9px;height:9px;margin:-6px;border:2px solid #e03131;border-radius:50%";
    mark.style = `${css};background:rgb(255 255 255 / 60%)`;
    const text = mark.appendChild(document.createElement("span"));
    text.style = `position:absolute;left:16px;top:-8px;padding:3px 6px;border-radius:4px;white-space:nowrap;font:12px/1.2 system-ui,sans-serif;
      color:var(--mantine-color-text,#222);background:var(--mantine-color-body,#fff);border:1px solid var(--mantine-color-default-border,#ccc)`;
    mark.hidden = true;
    function draw() {
      const { clientX, clientY, target, buttons } = moved;
      moved = undefined;
      const prefix = document.querySelector("[data-hover]")?.dataset.hover;
      const isOver = prefix && !buttons && target.matches?.("canvas[data-engine]");
      const box = isOver && target.getBoundingClientRect();
      const found = isOver && find(prefix, (2 * (clientX - box.left)) / box.width - 1, 1 - (2 * (clientY - box.top)) / box.height);
      mark.hidden = !found;
      if (!found) return;
      const at = found.world.project(window.__viserMutable.camera);
      mark.style.left = `${box.left + ((1 + at.x) / 2) * box.width}px`;
      mark.style.top = `${box.top + ((1 - at.y) / 2) * box.height}px`;
      const [x, y, z] = found.mm.map(mm => mm.toFixed(2));
      text.textContent = `x ${x}, y ${y}, z ${z} mm`;
    }
    addEventListener("pointermove", event => {
      if (!moved && window.__viserMutable) requestAnimationFrame(draw);
      if (window.__viserMutable) moved = event;
    });
  }
  addEventListener("DOMContentLoaded", build);
})();
