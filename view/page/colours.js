// Colours: of depths (near is warm, far is cold), of kinds, of tracks and of two variants.

/** The colour scale: position, red, green, blue. */
const STOPS = [
    [0.0, 255, 222, 158], [0.14, 250, 172, 96], [0.32, 222, 104, 78], [0.5, 158, 66, 104],
    [0.68, 94, 58, 128], [0.85, 50, 52, 112], [1.0, 26, 40, 78],
];

/** The colour of pixels without a measurement. */
export const HOLE = [10, 13, 19];

const KINDS = { sphere: [255, 135, 60], cylinder: [80, 225, 110], cone: [90, 175, 255] };

/** The colours of picture_sink, for the colour-blind (after Okabe and Ito). */
const TRACKS = [
    [245, 170, 40], [95, 190, 245], [20, 190, 140], [250, 235, 90], [70, 140, 230], [240, 110, 40], [225, 140, 190],
];

/** The colours of two compared variants. */
const VARIANTS = { a: [250, 170, 50], b: [85, 195, 255] };

/** The scale in 256 colours, four bytes each. */
export const SCALE = new Uint8Array(4 * 256);
for (let i = 0; i < 256; i += 1) {
    const at = i / 255;
    const next = Math.max(1, STOPS.findIndex(([stop]) => stop >= at));
    const [[from, ...a], [to, ...b]] = [STOPS[next - 1], STOPS[next]];
    const part = (at - from) / (to - from);
    for (let channel = 0; channel < 3; channel += 1) {
        SCALE[4 * i + channel] = a[channel] + (b[channel] - a[channel]) * part;
    }
    SCALE[4 * i + 3] = 255;
}

/** The colour of an item as three numbers up to 255: by its variant, by its number for a track, by its kind for an object. */
export const colourOf = (item) => VARIANTS[item.variant] ?? (item.id === undefined ? KINDS[item.kind] : TRACKS[item.id % TRACKS.length]);

/** The colour in CSS. */
export const css = ([red, green, blue], opacity = 1) => `rgb(${red} ${green} ${blue} / ${opacity})`;

/** The range of depths of the colour scale; it follows the frames slowly, to avoid flicker. */
export class DepthRange {
    near = 0;
    far = 0;

    /** Follows a frame, using the 1st and the 97th percentile of its depths. */
    follow(pixels, scale) {
        const stride = Math.max(1, Math.floor(pixels.length / 4096));
        const sample = [];
        for (let i = 0; i < pixels.length; i += stride) {
            if (pixels[i] !== 0 && pixels[i] !== 65535) {
                sample.push(pixels[i]);
            }
        }
        if (sample.length === 0) {
            return;
        }
        sample.sort((a, b) => a - b);
        const near = sample[Math.floor(sample.length * 0.01)] * scale;
        const far = Math.max(sample[Math.floor(sample.length * 0.97)] * scale, near * 1.02);
        const jumps = this.far === 0 || Math.abs(far - this.far) > this.far / 2 || Math.abs(near - this.near) > this.far / 3;
        const pace = jumps ? 1 : 0.08;
        this.near += (near - this.near) * pace;
        this.far += (far - this.far) * pace;
    }
}
