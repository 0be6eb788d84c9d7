// Figures and moments as people read them.

const TIME = new Intl.DateTimeFormat(undefined, {
  hour: "2-digit",
  minute: "2-digit",
  second: "2-digit",
  hourCycle: "h23",
});
const DAY_AND_TIME = new Intl.DateTimeFormat(undefined, {
  day: "numeric",
  month: "short",
  hour: "2-digit",
  minute: "2-digit",
  hourCycle: "h23",
});
const DAY_OF_A_YEAR = new Intl.DateTimeFormat(undefined, { day: "numeric", month: "short", year: "numeric" });
const MOST_NAMED = 4;
const UNITS = ["B", "kB", "MB", "GB", "TB"];

/** The time of day. */
export function time(moment) {
  return TIME.format(new Date(moment));
}

/** The time of day if it was today, with the day if not, and the day alone of another year. */
export function when(moment) {
  const then = new Date(moment);
  const now = new Date();
  if (then.getFullYear() !== now.getFullYear()) return DAY_OF_A_YEAR.format(then);
  return (then.toDateString() === now.toDateString() ? TIME : DAY_AND_TIME).format(then);
}

/** A length of time: "12 s", "3 min 05 s", "2 h 10 min". */
export function span(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, "0")} s`;
  return `${Math.floor(whole / 3600)} h ${String(Math.floor((whole % 3600) / 60)).padStart(2, "0")} min`;
}

/** A number of bytes. */
export function bytes(number) {
  let power = 0;
  while (number >= 999.5 && power < UNITS.length - 1) {
    number /= 1000;
    power++;
  }
  return `${number < 10 && power ? number.toFixed(1) : Math.round(number)} ${UNITS[power]}`;
}

/** A number with three digits that count. */
export function figure(number) {
  if (number === null || number === undefined || !Number.isFinite(number)) return "–";
  if (number !== 0 && (Math.abs(number) < 1e-3 || Math.abs(number) >= 1e6)) {
    return Number(number.toPrecision(3)).toExponential();
  }
  return String(Number(number.toPrecision(Number.isInteger(number) ? 15 : 3)));
}

/** The beginning of an id: enough to tell two of a list apart. */
export function short(id) {
  return id.slice(0, 8);
}

/** "1 scan", "3 scans". */
export function count(number, one, many = `${one}s`) {
  return `${number} ${number === 1 ? one : many}`;
}

/** The first of some names, and how many more there are. */
export function some(names) {
  const rest = names.length - MOST_NAMED;
  return names.slice(0, MOST_NAMED).join(", ") + (rest > 0 ? ` and ${rest} more` : "");
}

/** A key such as `fit_geometry` as words: "Fit geometry". */
export function plain(key) {
  const text = key.replaceAll("_", " ");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** Labels as they stand behind a name: ", actor: 17, session: Monday". */
export function labelWords(labels) {
  return Object.entries(labels).map(([key, value]) => `, ${key}: ${value}`).join("");
}
