// A list that comes in pages, newest first.

import { get } from "../api.js";
import { h } from "../dom.js";
import { keyed } from "../keyed.js";
import { table } from "./frame.js";
import { doing } from "./toast.js";

/**
 * A table of what the API lists at `path`, with buttons to turn pages.
 *
 * `row(item)` returns an item's table row, `empty` is shown where there is none. `query` can be set
 * before a `refresh`; `first` goes back to the first page, `shown(items)` is told what is shown.
 */
export class Paged {
  constructor({ path, label, columns, row, empty, signal, size = 50, shown = () => {} }) {
    this.path = path;
    this.signal = signal;
    this.size = size;
    this.query = {};
    this.cursors = [null];
    this.asked = 0;
    this.shown = shown;
    const body = h("tbody");
    // an item that has changed is another: only its row is made anew
    this.showRows = keyed(body, ({ item }) => ({ element: row(item), update() {} }));
    this.table = table(columns, body);
    this.empty = h("p", { class: "empty", hidden: true }, empty);
    this.newer = h("button", { type: "button", hidden: true, onclick: () => this.turn(this.newer, -1) }, "Newer");
    this.older = h("button", { type: "button", hidden: true, onclick: () => this.turn(this.older, 1) }, "Older");
    this.elements = [
      h("section", { class: "panel", "aria-label": label }, this.table, this.empty),
      h("nav", { class: "row", "aria-label": "Pages of the list" }, this.newer, this.older),
    ];
  }

  /** Ask for the page and show it. */
  async refresh() {
    const query = { ...this.query, limit: this.size, cursor: this.cursors.at(-1) };
    const mine = ++this.asked;
    const { items, next } = await get(this.path, query, this.signal);
    if (mine !== this.asked) return; // of another page or query by now
    this.next = next;
    this.showRows(items.map((item) => ({ id: JSON.stringify(item), item })));
    this.table.hidden = !items.length;
    this.empty.hidden = items.length > 0;
    this.newer.hidden = this.cursors.length === 1;
    this.older.hidden = !next;
    this.shown(items);
  }

  /** Go to the first page of a list that is asked for anew. */
  async first(query = this.query) {
    this.query = query;
    this.cursors = [null];
    return this.refresh();
  }

  async turn(button, by) {
    const before = this.cursors;
    this.cursors = by > 0 ? [...before, this.next] : before.slice(0, -1);
    await doing(button, async () => {
      try {
        await this.refresh();
        scrollTo(0, 0);
      } catch (error) {
        this.cursors = before;
        throw error;
      }
    });
  }
}
