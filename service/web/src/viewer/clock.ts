// When each frame of a sequence is shown.

export class Clock {
  /** `times` has the seconds of every frame from the first, increasing. */
  constructor(private readonly times: ArrayLike<number>) {}

  /** A clock on which all frames last equally long. */
  static even(frames: number, fps: number): Clock {
    return new Clock(Array.from({ length: frames }, (_, frame) => frame / fps));
  }

  /** Seconds of the last frame. */
  get last(): number {
    return this.times[this.times.length - 1] ?? 0;
  }

  /** Return the seconds at a time in frames, 0 … frames − 1. */
  seconds(frame: number): number {
    const before = Math.min(Math.floor(frame), this.times.length - 1);
    const [from, to] = [this.times[before] ?? 0, this.times[before + 1] ?? this.last];
    return from + (frame - before) * (to - from);
  }

  /** Return the time in frames at some seconds, 0 … `last`. */
  frame(seconds: number): number {
    let [low, high] = [0, this.times.length - 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if ((this.times[middle] as number) <= seconds) low = middle;
      else high = middle;
    }
    const [from, to] = [this.times[low] ?? 0, this.times[high] ?? 0];
    return to > from ? Math.min(high, low + (seconds - from) / (to - from)) : low;
  }
}
