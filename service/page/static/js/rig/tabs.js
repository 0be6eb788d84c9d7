// Tabs after the WAI-ARIA pattern: arrow keys go from one to the next.

import { h } from "../dom.js";

/** Return an element with a tab for each of `panels`, { name, title, element }; `opened(name)` is told. */
export function tabs(label, panels, opened = () => {}) {
  const buttons = panels.map(({ name, title, element }) => {
    element.id ||= `tab-panel-${name}`;
    element.setAttribute("role", "tabpanel");
    element.setAttribute("aria-label", title);
    return h("button", {
      type: "button", role: "tab", "aria-controls": element.id, onclick: () => open(name),
    }, title);
  });
  const open = (name) => {
    panels.forEach((panel, i) => {
      const isOpen = panel.name === name;
      panel.element.hidden = !isOpen;
      buttons[i].setAttribute("aria-selected", String(isOpen));
      buttons[i].tabIndex = isOpen ? 0 : -1;
    });
    opened(name);
  };
  const list = h("div", {
    class: "tabs", role: "tablist", "aria-label": label,
    onkeydown: (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = (buttons.indexOf(event.target) + step + buttons.length) % buttons.length;
      open(panels[next].name);
      buttons[next].focus();
    },
  }, buttons);
  open(panels[0].name);
  return { element: h("div", { class: "tabbed" }, list, panels.map((panel) => panel.element)), open };
}
