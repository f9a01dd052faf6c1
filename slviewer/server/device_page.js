// What the pages of all devices do: they connect to the server, again by themselves unless another window is the device,
// and keep the screen on.

const FIRST_WAIT_MS = 250, LONGEST_WAIT_MS = 4000, ANOTHER_WINDOW = 4001;

class DeviceLink {
  // device: of which the page is one; facts(): plain values that describe the page;
  // receive(socket, header, payload): a message; changed(): the connection began or ended
  constructor(device, { facts, receive, changed }) {
    Object.assign(this, { device, facts, receive, changed });
    this.elsewhere = false;  // another window is the device
    this.socket = null;
    this.wait = FIRST_WAIT_MS;
    this.retry = 0;
    this.reported = "";
  }

  get open() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  // Reports the facts if they changed.
  report() {
    const now = this.facts(), text = JSON.stringify(now);
    if (text === this.reported || !this.open) return;
    this.reported = text;
    this.socket.send(JSON.stringify({ op: "report", facts: now }));
  }

  // take: even if another window is the device.
  connect(take = false) {
    clearTimeout(this.retry);
    this.elsewhere = false;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const mine = this.socket = new WebSocket(`${scheme}://${location.host}${location.pathname}`);
    mine.binaryType = "arraybuffer";
    mine.onopen = () => {
      this.wait = FIRST_WAIT_MS;
      const now = this.facts();
      this.reported = JSON.stringify(now);
      mine.send(JSON.stringify({ op: "hello", window: this.windowName(), take, facts: now }));
      this.changed();
    };
    mine.onmessage = ({ data }) => {
      if (mine !== this.socket) return;
      const length = new DataView(data).getUint32(0, true);
      const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      this.receive(mine, header, new Uint8Array(data, 4 + length));
    };
    mine.onclose = ({ code }) => {
      if (mine !== this.socket) return;
      this.socket = null;
      this.elsewhere = code === ANOTHER_WINDOW;
      this.changed();
      if (this.elsewhere) return;
      this.retry = setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
    };
  }

  windowName() {
    // sessionStorage outlives a reload and belongs to one window
    const key = `slviewer ${this.device}`;
    const name = sessionStorage.getItem(key) ?? Array.from(
      crypto.getRandomValues(new Uint32Array(4)), (part) => part.toString(36)).join("-");
    sessionStorage.setItem(key, name);
    return name;
  }
}

async function stayAwake() {
  try { await navigator.wakeLock?.request("screen"); } catch { /* refused where the page is hidden or not trusted */ }
}
