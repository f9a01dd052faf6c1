// What viser's client needs and a browser may lack: without it the client shows a panel of its own in place of the wizard.
//
// A system's locale may be C, which `Intl` refuses as a language.
try {
  new Intl.NumberFormat(navigator.language);
} catch {
  for (const [name, value] of Object.entries({ language: "en", languages: ["en"] })) Object.defineProperty(navigator, name, { get: () => value });
}
// The client handles the server's messages between two frames that it draws, so it must believe that it draws: without WebGL
// it gets a context that draws nothing.
(() => {
  const getContext = HTMLCanvasElement.prototype.getContext;
  const standIns = new WeakMap(); // by canvas
  const numbers = new Map(); // of constants, where the browser knows none
  const constant = (name) =>
    globalThis.WebGL2RenderingContext?.[name] ?? numbers.get(name) ?? numbers.set(name, numbers.size + 1e6).get(name);

  function standIn(canvas) {
    const counts = new Set(["ACTIVE_UNIFORMS", "ACTIVE_ATTRIBUTES", "ACTIVE_UNIFORM_BLOCKS"].map(constant));
    const answers = new Map([
      ["VERSION", "WebGL 2.0"],
      ["SHADING_LANGUAGE_VERSION", "WebGL GLSL ES 3.00"],
      ["VENDOR", "none"],
      ["RENDERER", "none"],
      ["SCISSOR_BOX", new Int32Array(4)],
      ["VIEWPORT", new Int32Array(4)],
    ].map(([name, value]) => [constant(name), value]));
    const count = (_, what) => (counts.has(what) ? 0 : true);
    const methods = {
      canvas,
      drawingBufferWidth: 1,
      drawingBufferHeight: 1,
      drawingBufferColorSpace: "srgb",
      getContextAttributes: () => ({ alpha: true, depth: true, stencil: false, antialias: false }),
      getSupportedExtensions: () => [],
      getExtension: () => null,
      getParameter: (what) => answers.get(what) ?? 4096,
      getShaderPrecisionFormat: () => ({ precision: 23, rangeMin: 127, rangeMax: 127 }),
      getProgramParameter: count,
      getShaderParameter: count,
      getProgramInfoLog: () => "",
      getShaderInfoLog: () => "",
      getAttribLocation: () => -1,
      getUniformLocation: () => null,
      getError: () => 0,
      isContextLost: () => false,
      checkFramebufferStatus: () => constant("FRAMEBUFFER_COMPLETE"),
      clientWaitSync: () => constant("ALREADY_SIGNALED"),
    };
    const act = () => undefined;
    const create = () => ({});
    const context = new Proxy(methods, {
      get(_, name) {
        if (typeof name !== "string" || name in methods) return methods[name];
        if (/^[A-Z][A-Z0-9_]*$/.test(name)) return constant(name);
        return /^(create|fenceSync)/.test(name) ? create : act;
      },
    });
    standIns.set(canvas, context);
    return context;
  }

  function report() {
    if (document.documentElement.dataset.drawing === "none") return;
    document.documentElement.dataset.drawing = "none"; // the style hides what belongs to the 3D view
    const line = document.body.appendChild(document.createElement("div"));
    line.id = "no-drawing";
    line.setAttribute("role", "status");
    line.textContent =
      "No 3D view: this browser has no WebGL. Panels, pictures, tables and exports work. To see and pick in 3D, switch on " +
      "hardware acceleration or WebGL in the browser's settings, or use another browser.";
  }

  HTMLCanvasElement.prototype.getContext = function (kind, ...options) {
    const context = standIns.get(this) ?? getContext.call(this, kind, ...options);
    if (context || !/^webgl/.test(kind)) return context;
    report();
    return standIn(this);
  };
})();
