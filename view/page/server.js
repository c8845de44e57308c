// Polls the server for news, and sends commands to it.

const browser = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
const AGAIN_MS = 1500;
/** Drawing a frame in less than this is fast: two refreshes of a screen. */
const SLOW_MS = 34;

const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

/** Waits until the page is visible: a hidden one does not poll. */
function visible() {
    if (!document.hidden) {
        return Promise.resolve();
    }
    return new Promise((done) => document.addEventListener("visibilitychange", done, { once: true }));
}

/** Decodes an answer: the length of a text, the text, the depths of the pixels. */
function read(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const answer = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const image = answer.frame?.image;
    if (image) {
        answer.frame.pixels = new Uint16Array(buffer, 4 + length, image.columns * image.rows);
    }
    // The track numbers of two variants are independent.
    for (const item of answer.frame?.items ?? []) {
        if (item.variant && item.id !== undefined) {
            item.id = `${item.variant}${item.id}`;
        }
    }
    return answer;
}

/**
 * Polls for ever. `wanted` returns the number of pixels per row, `show` draws an answer, `tell` reports the state of the
 * connection, `rest` returns the shortest time between two requests in milliseconds.
 */
export async function follow({ wanted, show, tell, rest }) {
    // The numbers of the last frame and of the last other change.
    let seen = { frames: 0, told: 0 };
    for (;;) {
        await visible();
        let answer;
        try {
            const query = new URLSearchParams({ browser, ...seen, columns: wanted() });
            const response = await fetch(`look?${query}`);
            if (!response.ok) {
                tell("bad", (await response.text()).trim());
                await sleep(AGAIN_MS);
                continue;
            }
            answer = read(await response.arrayBuffer());
        } catch {
            // There is no server, or the answer was cut.
            seen = { frames: 0, told: 0 };
            tell("bad", "conicflow view does not answer: has it ended? It is asked again.");
            await sleep(AGAIN_MS);
            continue;
        }
        seen = { frames: answer.frames, told: answer.told };
        await new Promise(requestAnimationFrame);
        const begin = performance.now();
        try {
            show(answer);
            tell("good", "");
        } catch (error) {
            // The next answer may succeed.
            reportError(error);
            tell("bad", `This page cannot draw what it got; it may help to load it anew (${error.message}).`);
        }
        // Wait until this answer is drawn. After a slow drawing rest as long as it took: the browser may run on the robot.
        await new Promise(requestAnimationFrame);
        const took = performance.now() - begin;
        await sleep(Math.max(took > SLOW_MS ? took : 0, rest() - took));
    }
}

/** Resolves when all earlier commands are sent. */
let sent = Promise.resolve();

/** Sends a command, such as { do: "pause" }, after the earlier ones: sent at once, they might arrive in another order. */
export function wish(command) {
    const body = JSON.stringify(command);
    const send = () => fetch("command", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    sent = sent.then(send).catch(() => {
        // The polling reports whether the server is there.
    });
}
