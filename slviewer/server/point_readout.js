// Marks the measured point that a click would pick, with its coordinates in mm, while the pointer moves over viser's 3D view.
// The server says of which objects, in an element of the panel: <i data-hover="/measure/surface">, the start of their names.
// Marks are dragged over the points of an object: <i data-drag="/measure/surface" data-marks="/measure/end 1;/measure/end 2">.
// Where one is released is sent as the message of viser's own handles.
(() => {
  const NEAR = 0.01; // distance of a point from the pointer's ray, as a share of its depth; as `nearest` in result_views.py
  const BEHIND = 0.02; // what lies in front comes first
  const FULL_FOV_DEG = 43; // of the view in which NEAR is meant
  const halfTan = deg => Math.tan((deg * Math.PI) / 360);
  const REACH_PX = 10; // of a mark
  const LEAST_STEP_PX = 3; // of a drag
  let dragged; // the mark that the pointer was pressed on
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

  /** The closest point to a pointer's event, as `find`. */
  function findAt(prefix, { clientX, clientY, target }) {
    const box = target.getBoundingClientRect();
    return find(prefix, (2 * (clientX - box.left)) / box.width - 1, 1 - (2 * (clientY - box.top)) / box.height);
  }

  /** Where a place of three.js's world is on the page, [x, y] px. */
  function project(world, canvas) {
    const [at, box] = [world.project(window.__viserMutable.camera), canvas.getBoundingClientRect()];
    return [box.left + ((1 + at.x) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height];
  }

  /** The name of the mark under the pointer. */
  function findMark({ clientX, clientY, target }) {
    const element = target.matches?.("canvas[data-engine]") && document.querySelector("[data-drag]");
    if (!element || !window.__viserMutable) return undefined;
    const { camera, nodeRefFromName: nodes } = window.__viserMutable;
    const distance = name => {
      const ball = nodes[`${name}/ball`];
      if (!ball) return Infinity;
      const [x, y] = project(ball.getWorldPosition(camera.position.clone()), target);
      return Math.hypot(x - clientX, y - clientY);
    };
    const [name] = element.dataset.marks.split(";").sort((a, b) => distance(a) - distance(b));
    return distance(name) < REACH_PX ? name : undefined;
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
      const { target, buttons } = moved;
      const prefix = document.querySelector(dragged ? "[data-drag]" : "[data-hover]")?.dataset[dragged ? "drag" : "hover"];
      const isOver = target.matches?.("canvas[data-engine]");
      if (isOver) target.style.cursor = dragged ? "grabbing" : !buttons && findMark(moved) ? "grab" : "";
      const found = prefix && isOver && (dragged || !buttons) && findAt(prefix, moved);
      mark.hidden = !found;
      if (found) {
        [mark.style.left, mark.style.top] = project(found.world, target).map(px => `${px}px`);
        const [x, y, z] = found.mm.map(mm => mm.toFixed(2));
        text.textContent = `x ${x}, y ${y}, z ${z} mm`;
        text.style.translate = "";
        const over = text.getBoundingClientRect().right - target.getBoundingClientRect().right;
        if (over > 0) text.style.translate = `${-over}px`; // not over the panel beside the view
      }
      moved = undefined;
    }
    function move(event) {
      if (!moved && window.__viserMutable) requestAnimationFrame(draw);
      if (window.__viserMutable) moved = event;
    }
    const release = event => {
      const found = findAt(document.querySelector("[data-drag]")?.dataset.drag, event);
      const owner = { name: dragged.name, owner: "" };
      if (!found) return;
      const place = { wxyz: [1, 0, 0, 0], position: found.mm };
      window.__sendToServer({ type: "TransformControlsUpdateMessage", ...place, ...owner });
      window.__sendToServer({ type: "TransformControlsDragEndMessage", ...owner });
    };
    // Each returns whether nothing else is to handle the event. That a button is pressed and released, viser handles too: without
    // steps in between, it is a click on what lies under the mark.
    const handlers = {
      pointerdown(event) {
        const name = !event.button && !event.ctrlKey && !event.metaKey && findMark(event);
        dragged = name ? { name, begin: [event.clientX, event.clientY], isMoved: false } : undefined;
        return false;
      },
      pointermove(event) {
        const [x, y] = dragged?.begin ?? [];
        if (dragged && !dragged.isMoved && Math.hypot(event.clientX - x, event.clientY - y) >= LEAST_STEP_PX) {
          dragged.isMoved = true;
          event.target.dispatchEvent(new PointerEvent("pointercancel", event)); // not a click
        }
        move(event);
        return Boolean(dragged);
      },
      pointerup(event) {
        if (dragged?.isMoved) release(event);
        dragged = undefined;
        move(event);
        return false;
      },
      pointerout({ relatedTarget }) {
        if (!relatedTarget && !dragged) mark.hidden = true; // the pointer left the page
        return false;
      },
      pointercancel({ isTrusted }) {
        if (isTrusted) dragged = undefined;
        return false;
      },
      keydown({ key }) {
        const drops = Boolean(dragged?.isMoved) && key === "Escape";
        if (drops) dragged = undefined;
        return drops;
      },
    };
    for (const [name, handle] of Object.entries(handlers))
      addEventListener(
        name,
        event => {
          if (!handle(event)) return;
          event.preventDefault();
          event.stopImmediatePropagation();
        },
        { capture: true },
      );
  }
  addEventListener("DOMContentLoaded", build);
})();
