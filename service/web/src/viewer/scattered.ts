// A few of many points, for pictures that would be covered by all of them.

/**
 * Return at most `most` of `count` indices, in ascending order: chosen at random, but always the same ones. Every n-th point of a
 * grid would be whole columns of it.
 */
export function scattered(count: number, most: number): number[] {
  const chosen: number[] = [];
  let state = 0;
  for (let index = 0; chosen.length < Math.min(count, most); index += 1) {
    // The generator mulberry32, and Knuth's selection sampling, which chooses every subset with the same probability.
    state = (state + 0x6d2b79f5) | 0;
    let mixed = Math.imul(state ^ (state >>> 15), 1 | state);
    mixed = (mixed + Math.imul(mixed ^ (mixed >>> 7), 61 | mixed)) ^ mixed;
    const share = ((mixed ^ (mixed >>> 14)) >>> 0) / 2 ** 32;
    if (share * (count - index) < most - chosen.length) chosen.push(index);
  }
  return chosen;
}
