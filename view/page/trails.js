// The trails of tracks: their centres during the last seconds, in the camera frame and, if the pose is known, in the world.

const LENGTH_S = 4;
const MOST_POINTS = 240;

/** Transforms a point from the camera frame to the world by `pose`, row-major [R | t]. */
export const toWorld = (pose, [x, y, z]) => pose.map(([a, b, c, t]) => a * x + b * y + c * z + t);

export class Trails {
    /** By camera, whose frames may alternate with those of others: its trails, and the epoch and stamp of its last frame. */
    #cameras = new Map();

    /** Adds a frame; a frame of another run, or of an earlier time, starts new trails. */
    follow({ origin, epoch, stamp_s: stamp, pose, items }) {
        const last = this.#cameras.get(origin);
        const goesOn = last && epoch === last.epoch && stamp >= last.stamp && stamp <= last.stamp + LENGTH_S;
        const trails = goesOn ? last.trails : new Map();
        this.#cameras.set(origin, { epoch, stamp, trails });
        for (const item of items.filter(({ id }) => id !== undefined)) {
            if (!trails.has(item.id)) {
                trails.set(item.id, []);
            }
            const world = pose ? toWorld(pose, item.center) : null;
            trails.get(item.id).push({ stamp, camera: item.center, world });
        }
        for (const [id, trail] of trails) {
            while (trail.length > MOST_POINTS || (trail.length > 0 && trail[0].stamp < stamp - LENGTH_S)) {
                trail.shift();
            }
            if (trail.length === 0) {
                trails.delete(id);
            }
        }
    }

    /** The points of a track in the frames of a camera, the oldest first; `frame` is "camera" or "world". */
    of(origin, id, frame) {
        return (this.#cameras.get(origin)?.trails.get(id) ?? []).map((point) => point[frame]).filter((point) => point);
    }
}
