// Draws a shape into viser's 3D view by dragging: a rectangle, a lasso, or the stroke of a brush. The server says which one,
// and how wide the brush is, in an element of the page: <i data-draw="brush" data-size="0.05">, a share of the view's height.
// The shape is drawn here while the pointer moves, and sent once, when it is released: as the message of viser's own
// rectangle, with all of its places in the view, from 0 at the upper left to 1, and with Shift. With Ctrl, a drag is left to
// viser, which turns the view; Esc drops the shape.
(() => {
  const MOST_PLACES = 2000, LEAST_STEP_PX = 2;
  let worker; // holds viser's WebSocket
  let shape; // what is being drawn, with its places in px of the page
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (data, ...rest) {
    if (data?.type === "set_server") worker = this;
    return post.call(this, data, ...rest);
  };

  const [svg, line] = ["svg", "path"].map((name) => document.createElementNS("http://www.w3.org/2000/svg", name));
  svg.style = "position:fixed;inset:0;width:100%;height:100%;pointer-events:none;z-index:200";
  line.style = "stroke-linecap:round;stroke-linejoin:round";
  svg.append(line);

  const begin = ({ target, pointerId, clientX, clientY, shiftKey }) => {
    const wanted = target.matches?.("canvas[data-engine]") && document.querySelector("[data-draw]");
    if (!wanted) return null;
    const box = target.getBoundingClientRect();
    const { draw: kind, size } = wanted.dataset;
    const places = [[clientX, clientY]];
    return { kind, box, places, width: size * box.height, pointer: pointerId, modifier: shiftKey ? "shift" : null };
  };
  const outline = ({ kind, places }) => {
    if (kind !== "rectangle") return places;
    const [[x, y], [right, low]] = [places[0], places.at(-1)];
    return [[x, y], [right, y], [right, low], [x, low]];
  };
  const draw = (drawn) => {
    const brush = drawn.kind === "brush";
    line.setAttribute("d", `M${outline(drawn).join("L")}${brush ? "l0 0" : "Z"}`);
    line.setAttribute("fill", brush ? "none" : "rgb(225 40 120 / 15%)");
    line.setAttribute("stroke", `rgb(225 40 120 / ${brush ? 35 : 100}%)`);
    line.setAttribute("stroke-width", brush ? drawn.width : 1.5);
    document.body.append(svg);
  };
  const end = () => {
    shape = null;
    svg.remove();
  };
  window.__sendToServer = (message) => worker?.postMessage({ type: "send", message });
  const send = (drawn) => {
    const { kind, box, modifier } = drawn;
    const places = outline(drawn).map(([x, y]) => [(x - box.left) / box.width, (y - box.top) / box.height]);
    // fewer would be a click, or viser's own rectangle
    while (kind === "brush" && places.length < 3) places.push(places[0]);
    if (places.length < 3) return;
    const pointer = { event_type: "rect-select", ray_origin: null, ray_direction: null, screen_pos: places, modifier };
    window.__sendToServer({ type: "ScenePointerMessage", ...pointer });
  };

  // Each returns whether nothing else is to handle the event.
  const handlers = {
    pointerdown(event) {
      if (shape || event.button || event.ctrlKey || event.metaKey) return Boolean(shape);
      shape = begin(event);
      if (!shape) return false;
      event.target.setPointerCapture(event.pointerId);
      document.activeElement?.blur(); // as clicks into the view do
      draw(shape);
      return true;
    },
    pointermove(event) {
      if (!shape) {
        const brush = begin(event);
        if (brush?.kind === "brush" && !event.buttons) draw(brush);
        else svg.remove();
        return false;
      }
      if (event.pointerId !== shape.pointer) return true;
      const place = [event.clientX, event.clientY];
      const [x, y] = shape.places.at(-1);
      if (Math.hypot(place[0] - x, place[1] - y) < LEAST_STEP_PX) return true;
      shape.places.push(place);
      if (shape.places.length > MOST_PLACES) shape.places = shape.places.filter((_, i) => i % 2 === 0);
      draw(shape);
      return true;
    },
    pointerup(event) {
      if (event.pointerId !== shape?.pointer) return Boolean(shape);
      if (shape.kind === "brush" || shape.places.length > 1) send(shape);
      end();
      return true;
    },
    pointercancel() {
      if (shape) end();
      return false;
    },
    keydown(event) {
      const drops = Boolean(shape) && event.key === "Escape";
      if (drops) end();
      return drops;
    },
  };
  for (const [name, handle] of Object.entries(handlers))
    window.addEventListener(
      name,
      (event) => {
        if (!handle(event)) return;
        event.preventDefault();
        event.stopImmediatePropagation();
      },
      { capture: true },
    );
})();
