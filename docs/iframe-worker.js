// Search of pages that are opened from the disk: browsers start no worker there, so its script runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = []; // messages for the script until it has run
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      frame.contentDocument.write("<body>"); // a document that stays, in Firefox too
      frame.contentDocument.close();
      this.frame = frame.contentWindow;
      this.frame.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = frame.contentDocument.createElement("script");
      script.src = new URL(url, location.href).href;
      script.onload = () => {
        this.ready = true;
        this.waiting.forEach((data) => this.receive(data));
      };
      frame.contentDocument.body.append(script);
    }
    receive(data) {
      this.frame.dispatchEvent(new this.frame.MessageEvent("message", { data }));
    }
    postMessage(data) {
      this.ready ? this.receive(data) : this.waiting.push(data);
    }
  };
}
