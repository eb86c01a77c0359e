// A sound for an alarm: two falling tones. Silent until somebody has turned it on with a click or a key.

export class Sound {
  constructor(button) {
    this.button = button;
    this.on = false;
    this.context = null;
  }

  toggle() {
    this.on = !this.on;
    this.button.setAttribute("aria-pressed", String(this.on));
    if (this.on) {
      this.context ??= new AudioContext();
      this.context.resume();
      this.alarm();
    }
  }

  alarm() {
    if (!this.on) return;
    const { context } = this;
    for (const [start, pitch] of [[0, 880], [0.18, 587]]) {
      const tone = new OscillatorNode(context, { frequency: pitch });
      const volume = new GainNode(context, { gain: 0 });
      const at = context.currentTime + start;
      volume.gain.setTargetAtTime(0.2, at, 0.01);
      volume.gain.setTargetAtTime(0, at + 0.13, 0.02);
      tone.connect(volume).connect(context.destination);
      tone.start(at);
      tone.stop(at + 0.3);
    }
  }
}
