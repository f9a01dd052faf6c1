// viser's page draws once for every batch of messages that its worker hands over. A page that was busy for a while finds
// dozens of them waiting; drawn one after the other, React takes them for an endless loop, throws (its error 185), and
// the rest of that batch is lost. So batches that wait together are handed over as one.
//
// The theme and the floor's colours follow the system: viser's server knows one for all browsers. Its buttons show no
// hints: they are kept for `control_script.js`.
const buttonHints = new Map();
// Colours of the lines of the floor, in the light and in the dark theme.
const FLOOR = { false: [[225, 229, 233], [190, 196, 202]], true: [[42, 45, 48], [62, 66, 70]] };
// Until the server's first messages are drawn, the client would show a panel of its own, for seconds on a slow machine; where
// none come, that says why. A wizard is drawn once its line of state is.
const starting = (() => {
  const { dataset } = document.documentElement;
  const show = () => {
    delete dataset.starting;
    watcher.disconnect();
  };
  const watcher = new MutationObserver(() => document.querySelector("[data-activity]") && show());
  watcher.observe(document, { childList: true, subtree: true });
  dataset.starting = "";
  setTimeout(show, 20000);
  let isWizard = false;
  return {
    end(messages) {
      isWizard ||= messages.some(({ props }) => props?.content?.includes?.("data-activity"));
      if (!isWizard) show();
    },
  };
})();
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
          if (data?.type === "message_batch") starting.end(data.messages);
        }
      };
      onmessage.set.call(this, ({ data }) => {
        wakeView();
        if (waiting.push(data) === 1) turn.port2.postMessage(null);
      });
    },
  });
})();
// viser's client draws the view at every refresh of the screen. Here it rests while nothing can have changed the view: no
// message has come, and nobody has done anything.
const wakeView = (() => {
  const AWAKE_MS = 1500, REST_MS = 10000;
  const request = requestAnimationFrame.bind(window), cancel = cancelAnimationFrame.bind(window);
  const waiting = new Map(), requested = new Map(); // by our own number
  let number = 0, until = performance.now() + 20000; // the page starts
  const pass = (id, draw) => {
    waiting.delete(id);
    requested.set(id, request((time) => requested.delete(id) && draw(time)));
  };
  window.requestAnimationFrame = (draw) => {
    if (performance.now() < until) pass(++number, draw);
    else waiting.set(++number, draw);
    return number;
  };
  window.cancelAnimationFrame = (id) => {
    waiting.delete(id);
    cancel(requested.get(id));
    requested.delete(id);
  };
  const passAll = () => waiting.forEach((draw, id) => pass(id, draw));
  const wake = (ms = AWAKE_MS) => {
    until = Math.max(until, performance.now() + ms);
    passAll();
  };
  setInterval(passAll, REST_MS); // what no event has announced
  for (const kind of ["pointermove", "pointerdown", "pointerup", "wheel", "keydown", "keyup", "input", "change", "drop", "load"])
    addEventListener(kind, () => wake(), { capture: true, passive: true });
  for (const kind of ["resize", "focus", "visibilitychange"]) addEventListener(kind, () => wake());
  return wake;
})();
// viser warns at every start, in a large box that stays, that the scene is drawn in software. It asks for the renderer's
// name first: here it gets none, and one line says so, once in a browser.
(() => {
  if (!globalThis.WebGL2RenderingContext) return;
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
        position: "fixed", bottom: "200px", left: "calc(100vw - var(--view-right) - var(--view-width) + 10px)", zIndex: "4",
        maxWidth: "max(calc(var(--view-width) - 290px), 200px)",
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
// Shows a line in the middle of the page; an empty text removes it.
const showNotice = (text) => {
  let line = document.getElementById("page-notice");
  if (!text) return line?.remove();
  if (!line) {
    line = document.body.appendChild(document.createElement("div"));
    line.id = "page-notice";
    line.setAttribute("role", "status");
  }
  line.textContent = text;
};
// Back leaves the page only where it is pressed twice. (A browser passes over an entry that was made without an act of the user.)
(() => {
  const keep = () => addEventListener("pointerdown", () => history.pushState(null, ""), { once: true, capture: true });
  keep();
  addEventListener("popstate", () => {
    showNotice("Back leaves the wizard: press it once more. The session and what runs in it go on.");
    setTimeout(showNotice, 5000);
    keep();
  });
})();
// Files and folders that are dropped on the page, or chosen in the dialog of one of its inputs for imports, are handed to that
// input; several, folders and images as one zip.
(() => {
  const input = 'input[type=file][accept^=".zip,.ply"]';
  const FOLDER = ",folder"; // behind the types of an input whose dialog takes a folder
  const image = /\.(arw|bmp|cr[23]|dng|jpe?g|nef|nrw|orf|pef|p[gp]m|png|raf|rw2|tiff?|webp)$/i;
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
      showNotice(`Reading ${files.length} files, ${Math.round((100 * parts.length) / 3 / files.length)} % …`);
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
  // own: the file itself of what is dropped. Without a path, as other programs may hand it over, Chromium has no entry for it, and
  // WebKit one that cannot be read.
  const list = async (entry, own) => {
    if (!entry) return [{ path: own.name, file: own }];
    if (entry.isFile) {
      const file = await new Promise((done, failed) => entry.file(done, own ? () => done(own) : failed));
      return [{ path: entry.fullPath.slice(1), file }];
    }
    const found = [];
    for (const reader = entry.createReader(); ; ) {
      const some = await new Promise((done, failed) => reader.readEntries(done, failed));
      if (!some.length) return found;
      for (const inner of some) found.push(...(await list(inner)));
    }
  };
  // both: where the page was drawn anew under the pointer, the next event enters it
  for (const kind of ["dragenter", "dragover"])
    addEventListener(kind, (event) => {
      if (event.dataTransfer.types.includes("Files")) event.preventDefault();
    });
  let isHanding = false;
  // files: [{path, file}] ...
  const hand = async (name, files, target) => {
    const given = new DataTransfer();
    const single = files.length === 1 && !files[0].path.includes("/") && !image.test(name);
    given.items.add(single ? files[0].file : new File([await zip(files)], `${name}.zip`));
    showNotice("");
    target ??= document.querySelector(input);
    for (let tries = 300; !target?.isConnected; target = document.querySelector(input)) {
      // looked for last, and for 30 s: the page may be drawing it anew; one that only watches has none
      if (!tries--) throw Error("this page only watches");
      await new Promise((done) => setTimeout(done, 100));
    }
    target.files = given.files;
    isHanding = true;
    target.dispatchEvent(new Event("change", { bubbles: true }));
    isHanding = false;
  };
  // Says why what is done with files failed: none may be left unread in silence.
  const attempt = async (act) => {
    try {
      await act();
    } catch (error) {
      showNotice(`The files could not be read: ${error.message}. Nothing was imported; see that they still exist and may be read.`);
      setTimeout(showNotice, 15000);
    }
  };
  addEventListener("drop", (event) => {
    const given = [...event.dataTransfer.items].map((item) => [item.webkitGetAsEntry(), item.getAsFile()]);
    const dropped = given.filter(([entry, own]) => entry ?? own);
    if (!dropped.length) return;
    event.preventDefault();
    showNotice("Listing the files …");
    attempt(async () => {
      const listed = await Promise.all(dropped.map((each) => list(...each)));
      await hand((dropped[0][0] ?? dropped[0][1]).name, listed.flat());
    });
  });
  // Its dialog takes several files, or a folder, as a drop does.
  addEventListener("click", ({ target }) => {
    if (!target.matches?.(input)) return;
    target.multiple = true;
    target.webkitdirectory = target.accept.endsWith(FOLDER);
  }, true);
  addEventListener("change", (event) => {
    const { target } = event;
    if (isHanding || !target.matches?.(input) || !target.files.length) return;
    event.stopImmediatePropagation();
    const files = [...target.files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
    attempt(() => hand(files[0].path.split("/")[0], files, target));
  }, true);
})();
