// Builders for parts of the page.

import { colourOf, css } from "./colours.js";

/** Creates an element with these properties and children. */
export function element(tag, properties, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

/** A spot in the colour of an item. */
export const swatch = (item) => element("i", { className: "swatch", style: `background: ${css(colourOf(item))}` });
