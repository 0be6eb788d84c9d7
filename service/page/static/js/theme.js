// Chooses the colours before anything is drawn; a classic script, since modules run too late.
(() => {
  "use strict";
  const KEY = "myoface.theme";
  const root = document.documentElement;

  function apply(choice) {
    if (choice === "light" || choice === "dark") root.dataset.theme = choice;
    else delete root.dataset.theme;
  }

  function tell() {
    document.dispatchEvent(new Event("themechange"));
  }

  let choice = localStorage.getItem(KEY) ?? "auto";
  apply(choice);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", tell);

  document.addEventListener("DOMContentLoaded", () => {
    const select = document.getElementById("theme");
    select.value = choice;
    select.addEventListener("change", () => {
      choice = select.value;
      localStorage.setItem(KEY, choice);
      apply(choice);
      tell();
    });
  });
})();
