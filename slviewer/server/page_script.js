// viser's page draws once for every batch of messages that its worker hands over. A page that was busy for a while finds
// dozens of them waiting; drawn one after the other, React takes them for an endless loop, throws (its error 185), and
// the rest of that batch is lost. So batches that wait together are handed over as one.
//
// The theme and the floor's colours follow the system: viser's server knows one for all browsers. Its buttons show no
// hints: they are kept for `control_script.js`.
const buttonHints = new Map();
// Colours of the lines of the floor, in the light and in the dark theme.
const FLOOR = { false: [[225, 229, 233], [190, 196, 202]], true: [[42, 45, 48], [62, 66, 70]] };
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const onmessage = Object.getOwnPropertyDescriptor(Worker.prototype, "onmessage");
  Object.defineProperty(Worker.prototype, "onmessage", {
    ...onmessage,
    set(handler) {
      const waiting = [];
      const turn = new MessageChannel();
      const themed = new Map();
      const adapt = (message) => {
        if (!message.props) message.dark_mode = dark.matches;
        else [message.props.cell_color, message.props.section_color] = FLOOR[dark.matches];
        return message;
      };
      dark.onchange = () => {
        const messages = [...themed.values()].map(({ ...message }) => {
          if (message.props) message.props = { ...message.props };
          return adapt(message);
        });
        handler.call(this, { data: { type: "message_batch", messages } });
      };
      turn.port1.onmessage = () => {
        const arrived = waiting.splice(0);
        for (let i = 0; i < arrived.length; ) {
          const data = arrived[i++];
          if (data?.type === "message_batch")
            while (arrived[i]?.type === "message_batch") data.messages = data.messages.concat(arrived[i++].messages);
          for (const message of data?.messages ?? []) {
            if (message.props?.hint) buttonHints.set(message.uuid, message.props.hint);
            if (message.type === "ThemeConfigurationMessage" || message.type === "GridMessage") {
              themed.set(message.type, message);
              adapt(message);
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
// Files and folders that are dropped on the page are handed to its input for imports; several, folders and images as one zip.
(() => {
  const input = 'input[type=file][accept^=".zip,.ply"]';
  const image = /\.(bmp|jpe?g|pgm|png|tiff?|webp)$/i;
  const table = Uint32Array.from({ length: 256 }, (_, n) => {
    for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
    return n;
  });
  const checksum = async (file) => {
    let crc = -1;
    for (const reader = file.stream().getReader(); ; ) {
      const { done, value } = await reader.read();
      if (done) return ~crc >>> 0;
      for (const byte of value) crc = table[(crc ^ byte) & 255] ^ (crc >>> 8);
    }
  };
  // [bytes, value] ... as a record of a zip
  const pack = (...fields) => {
    const view = new DataView(new ArrayBuffer(fields.reduce((sum, [bytes]) => sum + bytes, 0)));
    let at = 0;
    for (const [bytes, value] of fields) {
      bytes === 2 ? view.setUint16(at, value, true) : view.setUint32(at, value, true);
      at += bytes;
    }
    return view.buffer;
  };
  const zip = async (files) => {
    const parts = [], directory = [];
    let offset = 0;
    for (const { path, file } of files) {
      const name = new TextEncoder().encode(path);
      const sizes = [[4, file.size], [4, file.size], [2, name.length], [2, 0]];
      const about = [[2, 20], [2, 0x800], [2, 0], [2, 0], [2, 33], [4, await checksum(file)], ...sizes];
      parts.push(pack([4, 0x04034b50], ...about), name, file);
      directory.push(pack([4, 0x02014b50], [2, 20], ...about, [2, 0], [2, 0], [2, 0], [4, 0], [4, offset]), name);
      offset += 30 + name.length + file.size;
    }
    const { size } = new Blob(directory), count = files.length;
    const end = pack([4, 0x06054b50], [2, 0], [2, 0], [2, count], [2, count], [4, size], [4, offset], [2, 0]);
    return new Blob([...parts, ...directory, end]);
  };
  const list = async (entry) => {
    if (entry.isFile) {
      const file = await new Promise((done, failed) => entry.file(done, failed));
      return [{ path: entry.fullPath.slice(1), file }];
    }
    const found = [];
    for (const reader = entry.createReader(); ; ) {
      const some = await new Promise((done, failed) => reader.readEntries(done, failed));
      if (!some.length) return found;
      for (const inner of some) found.push(...(await list(inner)));
    }
  };
  addEventListener("dragover", (event) => {
    if (event.dataTransfer.types.includes("Files")) event.preventDefault();
  });
  addEventListener("drop", async (event) => {
    const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry()).filter(Boolean);
    if (!entries.length) return;
    event.preventDefault();
    const found = (await Promise.all(entries.map(list))).flat();
    const [first] = entries;
    const single = entries.length === 1 && first.isFile && !image.test(first.name);
    const given = new DataTransfer();
    given.items.add(single ? found[0].file : new File([await zip(found)], `${first.name}.zip`));
    let target; // looked for last, and for 30 s: the page may be drawing it anew; one that only watches has none
    for (let tries = 300; !(target = document.querySelector(input)); await new Promise((done) => setTimeout(done, 100)))
      if (!tries--) return;
    target.files = given.files;
    target.dispatchEvent(new Event("change", { bubbles: true }));
  });
})();
