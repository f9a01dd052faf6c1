// What the controls of viser's page lack: hints of buttons, names for screen readers, folders that open by the keyboard,
// and a live image in the view's corner that a click enlarges or shrinks.
(() => {
  const FOLDER = ".mantine-Paper-root[data-with-border] > .mantine-Paper-root:first-child";
  const CORNER = "div:has(> [data-live]) + div";
  const LIVE = `${CORNER} img`;
  const name = (element, attributes) => {
    for (const [key, value] of Object.entries(attributes))
      if (element.getAttribute(key) !== String(value)) element.setAttribute(key, value);
  };
  const size = new ResizeObserver(([{ target }]) => {
    const box = target.getBoundingClientRect();
    document.documentElement.style.setProperty("--view-right", `${innerWidth - box.right}px`);
    document.documentElement.style.setProperty("--view-width", `${box.width}px`);
  });
  let view = null;
  const liveSizes = {}; // chosen by a click, of each step's image: the server writes its marker anew with each camera
  const complete = () => {
    const canvas = document.querySelector("canvas");
    if (canvas && canvas !== view) size.observe((view = canvas));
    for (const button of document.querySelectorAll("button[id]:not([title])"))
      if (buttonHints.has(button.id)) button.title = buttonHints.get(button.id);
    for (const label of document.querySelectorAll(FOLDER))
      name(label, { role: "button", tabindex: 0, "aria-expanded": !label.querySelector(".tabler-icon-chevron-down") });
    for (const marker of document.querySelectorAll("[data-live]"))
      name(marker, { "data-live": liveSizes[marker.dataset.image] ?? marker.dataset.live });
    for (const image of document.querySelectorAll(LIVE))
      name(image, { role: "button", tabindex: 0, "aria-label": "Camera image", title: "Click to enlarge or shrink" });
    for (const label of document.querySelectorAll("label[for]"))
      for (const input of label.closest(".mantine-Text-root")?.parentElement.nextSibling?.querySelectorAll("input, [role=slider]") ?? [])
        name(input, { "aria-label": label.textContent });
    for (const image of document.querySelectorAll("img:not([alt])")) image.alt = "";
    for (const input of document.querySelectorAll("input[type=file]:not([aria-label])")) input.ariaLabel = "File";
    for (const close of document.querySelectorAll(".mantine-CloseButton-root"))
      name(close, { "aria-label": "Dismiss" });
    for (const icon of document.querySelectorAll("button > * > .tabler-icon-list-search"))
      name(icon.closest("button"), { "aria-label": "Commands" });
    for (const box of document.querySelectorAll("[style*='overflow-x:auto'], [style*='overflow-y:auto']"))
      name(box, { tabindex: 0 }); // so that the arrow keys scroll it
  };
  // before the next picture: at no time has a control no name, also where React sets it anew
  new MutationObserver(complete).observe(document, {
    attributeFilter: ["aria-label"],
    childList: true,
    subtree: true,
  });
  // A button's hint stands in the view, beside the panel: there it covers no other control, as the browser's own would.
  const hint = document.createElement("div");
  hint.id = "hint";
  let hinted = null, title = "";
  document.addEventListener("pointerover", ({ target }) => {
    if (target.matches?.("input[aria-haspopup=listbox]")) target.title = target.scrollWidth > target.clientWidth ? target.value : "";
    const button = target.closest?.("button[id]");
    if (button === hinted) return;
    if (hinted) hinted.title = title;
    hint.remove();
    hinted = null;
    if (!button?.title || !view) return;
    [hinted, title] = [button, button.title];
    button.title = "";
    hint.textContent = title;
    const box = button.getBoundingClientRect(), { left, right } = view.getBoundingClientRect();
    const side = box.left >= right - 1 ? { right: `${innerWidth - right + 6}px`, left: "auto" } : { left: `${left + 6}px`, right: "auto" };
    Object.assign(hint.style, { top: `${box.top}px`, maxWidth: `${right - left - 12}px`, ...side });
    document.body.append(hint);
  });
  document.addEventListener("click", ({ target }) => {
    const marker = target.closest(CORNER)?.previousSibling.firstChild; // the corner: a new picture may have come meanwhile
    if (marker) marker.dataset.live = liveSizes[marker.dataset.image] = marker.dataset.live === "large" ? "small" : "large";
  });
  document.addEventListener("keydown", event => {
    if ((event.key === "Enter" || event.key === " ") && event.target.matches(`${FOLDER}, ${LIVE}`)) {
      event.preventDefault();
      event.target.click();
    }
  });
})();
