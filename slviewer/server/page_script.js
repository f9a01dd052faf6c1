// viser's page draws once for every batch of messages that its worker hands over. A page that was busy for a while finds
// dozens of them waiting; drawn one after the other, React takes them for an endless loop, throws (its error 185), and
// the rest of that batch is lost. So batches that wait together are handed over as one.
//
// The theme follows the system: viser's server knows one for all browsers.
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
          for (const message of data?.messages ?? [])
            if (message.type === "ThemeConfigurationMessage") {
              message.dark_mode = dark.matches;
              dark.onchange = () => {
                const messages = [{ ...message, dark_mode: dark.matches }];
                handler.call(this, { data: { type: "message_batch", messages } });
              };
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
// viser writes the address of its WebSocket into the page's own, unless it has no path. Here every page has one, and the
// address stays as it is.
history.replaceState = () => {};
