// viser's page draws once for every batch of messages that its worker hands over. A page that was busy for a while finds
// dozens of them waiting; drawn one after the other, React takes them for an endless loop, throws (its error 185), and
// the rest of that batch is lost. So batches that wait together are handed over as one.
//
// The theme follows the system: viser's server knows one for all browsers. Its buttons show no hints: they are kept for
// `control_script.js`.
const buttonHints = new Map();
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const onmessage = Object.getOwnPropertyDescriptor(Worker.prototype, "onmessage");
  Object.defineProperty(Worker.prototype, "onmessage", {
    ...onmessage,
    set(handler) {
      const waiting = [];
      const turn = new MessageChannel();
      turn.port1.onmessage = () => {
        const arrived = waiting.splice(0);
        for (let i = 0; i < arrived.length; ) {
          const data = arrived[i++];
          if (data?.type === "message_batch")
            while (arrived[i]?.type === "message_batch") data.messages = data.messages.concat(arrived[i++].messages);
          for (const message of data?.messages ?? []) {
            if (message.props?.hint) buttonHints.set(message.uuid, message.props.hint);
            if (message.type === "ThemeConfigurationMessage") {
              message.dark_mode = dark.matches;
              dark.onchange = () => {
                const messages = [{ ...message, dark_mode: dark.matches }];
                handler.call(this, { data: { type: "message_batch", messages } });
              };
            }
          }
          try {
            handler.call(this, { data });
          } catch (error) {
            reportError(error); // and the rest is still handed over
          }
        }
      };
      onmessage.set.call(this, ({ data }) => {
        if (waiting.push(data) === 1) turn.port2.postMessage(null);
      });
    },
  });
})();
// viser warns at every start, in a large box that stays, that the scene is drawn in software. It asks for the renderer's
// name first: here it gets none, and one line says so, once in a browser.
(() => {
  const noted = "slviewer drawn in software";
  const prototype = WebGL2RenderingContext.prototype;
  const getExtension = prototype.getExtension;
  prototype.getExtension = function (name) {
    const extension = getExtension.call(this, name);
    if (name !== "WEBGL_debug_renderer_info" || !extension) return extension;
    const renderer = String(this.getParameter(extension.UNMASKED_RENDERER_WEBGL));
    if (!/swiftshader|llvmpipe|softpipe|software/i.test(renderer)) return extension;
    if (!localStorage.getItem(noted)) {
      localStorage.setItem(noted, "yes");
      const line = document.createElement("div");
      line.setAttribute("role", "status");
      line.textContent = "3D is drawn in software, slowly: switch on the browser's hardware acceleration.";
      Object.assign(line.style, {
        position: "fixed", bottom: "4px", left: "50%", transform: "translateX(-50%)", zIndex: "10",
        font: "12px sans-serif", color: "#495057", background: "#ffffffd9", padding: "2px 8px", borderRadius: "4px",
      });
      document.body.append(line);
      setTimeout(() => line.remove(), 12000);
    }
    return null;
  };
})();
// viser writes the address of its WebSocket into the page's own, unless it has no path. Here every page has one, and the
// address stays as it is.
history.replaceState = () => {};
