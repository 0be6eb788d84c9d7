// Building and changing elements. Text is always set as text, never parsed as HTML.

const SVG = "http://www.w3.org/2000/svg";

/**
 * Make an element. An attribute that is a function listens (`onclick`), true is an empty attribute,
 * false, null and undefined are none; children are nodes, texts, lists of them, or nothing.
 */
export function h(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** Make an SVG element; the same words as `h`. */
export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) {
      element.setAttribute(name, value);
    }
  }
  element.append(
    ...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false),
  );
  return element;
}

/** Return elements with commas between them. */
export function joined(elements) {
  return elements.flatMap((element, i) => (i ? [", ", element] : [element]));
}

/** Set an element's text if it is another: what has the focus or is read aloud stays. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Replace an element's children. */
export function show(element, ...children) {
  element.replaceChildren(
    ...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false),
  );
}

const GATHER_MS = 150;
let sentences = [];
let spoken = 0;

/** Have a screen reader say something when it is done with what it says now. */
export function announce(sentence) {
  sentences.push(sentence);
  if (sentences.length > 1) return;
  // what comes at once is said at once: a later text would take an earlier one's place unheard
  setTimeout(() => {
    // the same words twice are only heard twice if the text differs
    document.getElementById("announcer").textContent = sentences.join(". ") + (spoken++ % 2 ? "\u00a0" : "");
    sentences = [];
  }, GATHER_MS);
}
