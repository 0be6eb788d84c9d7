// A skin on a chain of joints, as glTF has it: each hangs on the one before, a fixed step away.

const BONES = 4; // joints that a vertex may have

/** Joints that carry a skin; lengths in mm. */
export class Joints {
  #rest;
  #turns;
  #bones;
  #shares;

  /**
   * `rest` are the joints' places [x, y, z], `turns` how each turns against the one before (`Track`
   * of quaternions x, y, z, w; null: not at all), `bones` and `shares` which four joints carry each
   * vertex, and how much.
   */
  constructor({ rest, turns, bones, shares }) {
    this.#rest = rest;
    this.#turns = turns;
    this.#bones = bones;
    this.#shares = shares;
  }

  /** Carry `places`, flat x, y, z, to where the joints have them at a time. */
  carry(places, time) {
    const moves = this.#moves(time);
    for (let vertex = 0, i = 0; i < places.length; vertex++, i += 3) {
      const [x, y, z] = [places[i], places[i + 1], places[i + 2]];
      places.fill(0, i, i + 3);
      for (let k = BONES * vertex; k < BONES * (vertex + 1); k++) {
        const share = this.#shares[k];
        if (share === 0) continue;
        const move = moves[this.#bones[k]];
        for (let row = 0; row < 3; row++) {
          places[i + row] += share * (move[row][0] * x + move[row][1] * y + move[row][2] * z + move[row][3]);
        }
      }
    }
  }

  /**
   * Return what each joint takes with it, at a time: three rows of a turn and a shift.
   *
   * Quaternions are taken on straight lines: the writer has them on one side (`steady_side`), and
   * holds the skin to its bound that way.
   */
  #moves(time) {
    let turned = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    let place = [0, 0, 0];
    return this.#rest.map((rest, k) => {
      const step = k ? rest.map((value, d) => value - this.#rest[k - 1][d]) : rest;
      place = sum(place, applied(turned, step));
      if (this.#turns[k]) turned = product(turned, rotation(this.#turns[k].at(time)));
      const back = applied(turned, rest);
      return turned.map((row, d) => [...row, place[d] - back[d]]);
    });
  }
}

function rotation(quaternion) {
  const length = Math.hypot(...quaternion);
  const [x, y, z, w] = quaternion.map((value) => value / length);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
  ];
}

function product(a, b) {
  return a.map((row) => [0, 1, 2].map((d) => row[0] * b[0][d] + row[1] * b[1][d] + row[2] * b[2][d]));
}

function applied(matrix, [x, y, z]) {
  return matrix.map((row) => row[0] * x + row[1] * y + row[2] * z);
}

function sum(a, b) {
  return a.map((value, d) => value + b[d]);
}
