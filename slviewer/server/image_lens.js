// A lens over the live image and the small pictures of captured frames: it enlarges what is under the pointer, and states
// its grey level and, where the camera's width is known, the camera's pixel. The picture is scaled and compressed, so that
// both are approximate. The server marks the pictures: <div data-live data-camera-px="1280"> before the live image, and
// data-zoom on the others. Where it offers the pixels of the stored frame, by data-frame with data-width and data-bytes of
// a pixel, the lens shows these.
(() => {
  const SIDE_PX = 168, ZOOM = 6; // of the lens, and screen px a pixel of the picture
  const LIVE = "div:has(> [data-live]) + div";
  const LEAST_COLOUR = 40; // difference of the channels of what is drawn into a grey picture
  let lens, canvas, text, image, pointer;
  let frame = {}; // the last one that was read: its address, and once it is there its pixels, width, height and brightest one

  const readFrame = async ({ frame: address, width, bytes }) => {
    frame = { address };
    const response = await fetch(address).catch(() => null);
    if (!response?.ok || frame.address !== address) return;
    const buffer = await response.arrayBuffer();
    const height = Math.floor(buffer.byteLength / bytes / width); // a checksum follows
    const pixels = new (bytes > 1 ? Uint16Array : Uint8Array)(buffer, 0, width * height);
    frame = { address, pixels, width: +width, height, most: pixels.reduce((a, b) => Math.max(a, b), 1) };
    draw();
  };
  /** Draw the pixels of the frame around one of them, [x, y], as bright as they are beside the brightest. */
  const drawFrame = (context, [x, y]) => {
    const half = SIDE_PX / ZOOM / 2;
    for (let v = -half; v <= half; v++)
      for (let u = -half; u <= half; u++) {
        if (x + u < 0 || y + v < 0 || x + u >= frame.width || y + v >= frame.height) continue;
        const grey = (255 * frame.pixels[(y + v) * frame.width + x + u]) / frame.most;
        context.fillStyle = `rgb(${grey} ${grey} ${grey})`;
        context.fillRect(SIDE_PX / 2 + (u - 0.5) * ZOOM, SIDE_PX / 2 + (v - 0.5) * ZOOM, ZOOM, ZOOM);
      }
  };

  const build = () => {
    lens = document.createElement("div");
    lens.id = "image-lens";
    lens.style =
      "position:fixed;z-index:300;pointer-events:none;border-radius:4px;overflow:hidden;font-size:12px;" +
      "background:var(--mantine-color-body);box-shadow:0 2px 10px rgb(0 0 0 / 35%)";
    canvas = document.createElement("canvas");
    canvas.width = canvas.height = SIDE_PX;
    canvas.style.display = "block";
    text = document.createElement("div");
    text.style = `width:${SIDE_PX}px;padding:3px 6px;box-sizing:border-box`;
    lens.append(canvas, text);
  };
  const draw = () => {
    if (!image?.isConnected || !image.naturalWidth) return lens?.remove();
    if (!lens) build();
    const box = image.getBoundingClientRect();
    // as object-fit: cover shows it
    const scale = Math.max(box.width / image.naturalWidth, box.height / image.naturalHeight);
    const at = [
      (pointer.clientX - box.left - box.width / 2) / scale + image.naturalWidth / 2,
      (pointer.clientY - box.top - box.height / 2) / scale + image.naturalHeight / 2,
    ];
    const context = canvas.getContext("2d", { willReadFrequently: true });
    const [left, top] = at.map(each => Math.floor(each) + 0.5 - SIDE_PX / ZOOM / 2);
    context.imageSmoothingEnabled = false;
    context.clearRect(0, 0, SIDE_PX, SIDE_PX);
    const { frame: address } = image.dataset;
    if (address && address !== frame.address) readFrame(image.dataset);
    const scaled = address && address === frame.address && frame.pixels && frame.width / image.naturalWidth;
    const place = scaled && at.map((each, i) => Math.min(Math.max(Math.floor(each * scaled), 0), [frame.width, frame.height][i] - 1));
    context.drawImage(image, -left * ZOOM, -top * ZOOM, image.naturalWidth * ZOOM, image.naturalHeight * ZOOM);
    const [red, green, blue] = context.getImageData(SIDE_PX / 2, SIDE_PX / 2, 1, 1).data;
    if (place) drawFrame(context, place);
    context.strokeStyle = "#f59f00";
    context.strokeRect((SIDE_PX - ZOOM) / 2, (SIDE_PX - ZOOM) / 2, ZOOM, ZOOM);
    const isDrawn = Math.max(red, green, blue) - Math.min(red, green, blue) > LEAST_COLOUR;
    const cameraPx = +image.closest(LIVE)?.previousElementSibling.firstElementChild.dataset.cameraPx;
    const pixel = cameraPx ? at.map(each => Math.round((each * cameraPx) / image.naturalWidth)) : null;
    const grey = isDrawn ? "covered by a mark" : `grey level about ${green} of 255`;
    if (place) text.textContent = `x ${place[0]}, y ${place[1]} px: grey level ${frame.pixels[place[1] * frame.width + place[0]]}`;
    else text.textContent = (pixel ? `x ${pixel[0]}, y ${pixel[1]} px: ` : "") + grey;
    document.body.append(lens);
    // beside the pointer, where there is room
    const room = [innerWidth, innerHeight], size = [lens.offsetWidth, lens.offsetHeight];
    const [x, y] = [pointer.clientX, pointer.clientY].map((each, i) =>
      each + 16 + size[i] < room[i] ? each + 16 : each - 16 - size[i],
    );
    lens.style.left = `${x}px`;
    lens.style.top = `${y}px`;
  };
  addEventListener(
    "pointermove",
    event => {
      const isPicture = event.target.matches?.(`${LIVE} img, img[data-zoom]`);
      image = isPicture ? event.target : null;
      pointer = event;
      draw();
    },
    { passive: true },
  );
  addEventListener("load", ({ target }) => target === image && draw(), { capture: true }); // the next live frame
})();
