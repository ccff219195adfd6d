// A recording as the page plays it: rows of numbers on a grid of times. The whole run, thinned, is there at
// once; the piece about a moment comes in full when it is asked for.

const PIECES_MAX = 24; // kept of those that came

export class Recorded {
  // scene: as deploy/playback/scene.py gives it. overview: Float32Array of its thinned rows.
  // fetchPiece(number): gives a promise of a Float32Array; left out where there is nothing but the overview.
  constructor(scene, overview, fetchPiece) {
    const { columns } = scene;
    const { width, rate_hz, rows, stride, piece_rows } = scene.track;
    Object.assign(this, { scene, overview, fetchPiece, width, rate: rate_hz, rows, stride, pieceRows: piece_rows });
    this.columns = columns.length;
    this.at = Object.fromEntries(columns.map((name, index) => [name, index]));
    this.end = (rows - 1) / rate_hz;
    this.pieces = new Map();
    this.waiting = new Map();
    this.row = new Float32Array(width);
  }

  // Row number k of the overview is which row of the grid.
  rowOf(k) {
    return Math.min(k * this.stride, this.rows - 1);
  }

  timeText(t) {
    return `${t.toFixed(2)} of ${this.scene.end_s.toFixed(1)} s`;
  }

  // Calls put(i, j, wanted) for each edge that is in force in a frame: places of its robots, its distance in m.
  eachEdge({ row }, put) {
    const from = this.scene.robots.length * this.columns;
    this.scene.edges.forEach(([i, j], index) => {
      if (!Number.isNaN(row[from + index])) put(i, j, row[from + index]);
    });
  }

  // Calls put(x, y) for where a robot was from one time to another.
  path(robot, from_s, to_s, put) {
    const { overview, width, columns, at } = this;
    const per = this.stride / this.rate;
    const last = Math.min(Math.floor(to_s / per), this.overviewRows - 1);
    for (let k = Math.max(0, Math.floor(from_s / per)); k <= last; k++) {
      const from = k * width + robot * columns;
      put(overview[from + at.x], overview[from + at.y]);
    }
  }

  get overviewRows() {
    return this.overview.length / this.width;
  }

  // The robots at fleet time t (s): {t, row, exact}. Exact: from the recording's own rows.
  frame(t) {
    const place = Math.min(Math.max(t * this.rate, 0), this.rows - 1);
    const first = Math.floor(place);
    const second = Math.min(first + 1, this.rows - 1);
    const here = this.full(first);
    const next = this.full(second);
    if (here && next) {
      this.between(here, next, place - first);
      return { t, row: this.row, exact: true };
    }
    const k = Math.min(Math.floor(place / this.stride), this.overviewRows - 1);
    const l = Math.min(k + 1, this.overviewRows - 1);
    const [from, to] = [this.rowOf(k), this.rowOf(l)];
    const view = (n) => this.overview.subarray(n * this.width, (n + 1) * this.width);
    this.between(view(k), view(l), to > from ? (place - from) / (to - from) : 0);
    return { t, row: this.row, exact: this.stride === 1 };
  }

  full(row) {
    const piece = this.pieces.get(Math.floor(row / this.pieceRows));
    if (!piece) return null;
    const from = (row % this.pieceRows) * this.width;
    return piece.subarray(from, from + this.width);
  }

  // The row that is `share` of the way from row a to row b.
  between(a, b, share) {
    const { row, at, columns, width } = this;
    const robots = this.scene.robots.length;
    row.set(share < 1 ? a : b);
    if (share <= 0 || share >= 1) return;
    for (let robot = 0; robot < robots; robot++) {
      const from = robot * columns;
      for (const name of ["x", "y", "speed", "place_x", "place_y"]) {
        const i = from + at[name];
        const value = a[i] + share * (b[i] - a[i]);
        row[i] = Number.isNaN(value) ? a[i] : value;
      }
      const i = from + at.heading;
      const turn = Math.atan2(Math.sin(b[i] - a[i]), Math.cos(b[i] - a[i]));
      row[i] = a[i] + share * turn;
    }
    for (let i = robots * columns; i < width; i++) {
      const value = a[i] + share * (b[i] - a[i]);
      row[i] = Number.isNaN(value) ? a[i] : value;
    }
  }

  // Asks for the piece about t, and for the one after it. Gives a promise that is kept when the first is there.
  want(t, ahead = 1) {
    if (!this.fetchPiece || this.stride === 1) return Promise.resolve();
    const row = Math.min(Math.max(Math.floor(t * this.rate), 0), this.rows - 1);
    const first = Math.floor(row / this.pieceRows);
    const last = Math.floor((this.rows - 1) / this.pieceRows);
    const wanted = [];
    for (let number = first; number <= Math.min(first + ahead, last); number++) wanted.push(this.load(number));
    wanted.slice(1).forEach((each) => each.catch(() => {})); // it is asked for again when it is looked at
    return wanted[0];
  }

  load(number) {
    if (this.pieces.has(number)) return Promise.resolve();
    if (!this.waiting.has(number)) {
      const came = this.fetchPiece(number)
        .then((piece) => {
          this.pieces.set(number, piece);
          if (this.pieces.size > PIECES_MAX) this.pieces.delete(this.pieces.keys().next().value);
        })
        .finally(() => this.waiting.delete(number));
      this.waiting.set(number, came);
    }
    return this.waiting.get(number);
  }

  // State and reason of the robot with this index at t.
  state(robot, t) {
    const changes = this.scene.states[robot];
    let [low, high] = [0, changes.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (changes[middle][0] <= t + 1e-9) low = middle + 1;
      else high = middle;
    }
    return low ? changes[low - 1] : changes[0] || [0, "", ""];
  }
}
