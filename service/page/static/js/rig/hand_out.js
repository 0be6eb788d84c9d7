// Handing things to the person: a picture as a file, the address as text.

import { announce } from "../dom.js";

/** Have the browser save a blob as a file. */
export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** Copy the address; returns what to say of it. */
export async function copyAddress() {
  try {
    await navigator.clipboard.writeText(location.href);
    announce("Link copied");
    return "Link copied";
  } catch {
    return "This browser does not let the page copy: the link is the address above.";
  }
}
