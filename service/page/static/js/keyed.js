// Lists that change in place: a row stays the same element, so it keeps the focus and is not read
// aloud again.

/**
 * Return a function that shows items with an `id` as children of `container`, in their order.
 * `make(item)` returns `{element, update}`; `update(item)` is called each time it is shown.
 */
export function keyed(container, make) {
  const rows = new Map();
  return (items) => {
    const wanted = new Set(items.map((item) => item.id));
    for (const [id, row] of rows) {
      if (wanted.has(id)) continue;
      row.element.remove();
      rows.delete(id);
    }
    let place = container.firstChild;
    for (const item of items) {
      let row = rows.get(item.id);
      if (!row) rows.set(item.id, (row = make(item)));
      row.update(item);
      if (row.element === place) place = place.nextSibling;
      else container.insertBefore(row.element, place);
    }
  };
}
