// 3D shapes of spheres, cylinders and cones: surface, axis and velocity, and a halo that shows the uncertainty.

import {
    BackSide, BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, DoubleSide, Group, Line, LineBasicMaterial,
    LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial, Quaternion, SphereGeometry, Vector3,
} from "./three/three.min.js";
import { colourOf } from "./colours.js";
import { norm, sureness } from "./words.js";

const AROUND = 48;
/** Velocity arrows show the motion of this many seconds. */
const ARROW_S = 0.5;
/** An item that moves by less than this many standard deviations may stand still. */
const MOVES_SIGMAS = 3;
const UP = new Vector3(0, 1, 0);

const colour = (item) => new Color().setRGB(...colourOf(item).map((part) => part / 255), "srgb");

/** Joins points (three numbers each) by lines; `LineSegments` joins them in pairs. */
function line(points, options, Kind = Line) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(points.flat()), 3));
    return new Kind(geometry, new LineBasicMaterial({ transparent: true, ...options }));
}

/** The surface, offset outwards by `wider` metres. */
function surface(item, wider) {
    if (item.kind === "sphere") {
        return new SphereGeometry(Math.max(item.radius + wider, 0.001), AROUND, AROUND / 2);
    }
    // The axis leads from the apex to the base; that of a CylinderGeometry to its "top".
    const [narrow, wide] = item.kind === "cone" ? [item.top_radius, item.base_radius] : [item.radius, item.radius];
    return new CylinderGeometry(Math.max(wide + wider, 0), Math.max(narrow + wider, 0), item.length + 2 * wider, AROUND, 1, wider > 0);
}

/** Rings and edges of the surface as lines. */
function rings(item) {
    const circle = (radius, height) => {
        const points = [];
        for (let i = 0; i <= AROUND; i += 1) {
            const angle = (2 * Math.PI * i) / AROUND;
            points.push([radius * Math.cos(angle), height, radius * Math.sin(angle)]);
        }
        return points;
    };
    if (item.kind === "sphere") {
        const equator = circle(item.radius, 0);
        return [equator, equator.map(([x, y, z]) => [x, z, y]), equator.map(([x, y, z]) => [y, x, z])];
    }
    const [narrow, wide] = item.kind === "cone" ? [item.top_radius, item.base_radius] : [item.radius, item.radius];
    const half = item.length / 2;
    const sides = [0, 0.25, 0.5, 0.75].map((part) => {
        const [cosine, sine] = [Math.cos(2 * Math.PI * part), Math.sin(2 * Math.PI * part)];
        return [[wide * cosine, half, wide * sine], [narrow * cosine, -half, narrow * sine]];
    });
    return [circle(wide, half), circle(narrow, -half), ...sides];
}

/**
 * The transformation of a unit sphere to the ellipsoid of the centre's uncertainty, `sigmas` standard deviations wide: the
 * Cholesky factor of the covariance.
 */
function centreHalo(covariance, sigmas) {
    const l = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
    for (let i = 0; i < 3; i += 1) {
        for (let j = 0; j <= i; j += 1) {
            let sum = covariance[i][j];
            for (let k = 0; k < j; k += 1) {
                sum -= l[i][k] * l[j][k];
            }
            l[i][j] = i === j ? Math.sqrt(Math.max(sum, 1e-12)) : sum / l[j][j];
        }
    }
    const s = sigmas;
    return new Matrix4().set(
        s * l[0][0], 0, 0, 0, s * l[1][0], s * l[1][1], 0, 0, s * l[2][0], s * l[2][1], s * l[2][2], 0, 0, 0, 0, 1,
    );
}

/** The shape of an item in the camera frame; `halo` in standard deviations. */
export function shape(item, halo, isChosen) {
    const group = new Group();
    const [tint, sure] = [colour(item), sureness(item)];
    const turned = new Group();
    turned.position.fromArray(item.center);
    if (item.axis) {
        turned.quaternion.copy(new Quaternion().setFromUnitVectors(UP, new Vector3().fromArray(item.axis).normalize()));
    }
    const skin = new MeshStandardMaterial({
        color: tint, transparent: true, opacity: 0.1 + 0.32 * sure, side: DoubleSide, depthWrite: false, roughness: 0.55,
    });
    turned.add(new Mesh(surface(item, 0), skin));
    const edge = { color: isChosen ? new Color("#ffffff") : tint, opacity: isChosen ? 1 : 0.25 + 0.75 * sure };
    rings(item).forEach((ring) => turned.add(line(ring, edge)));
    if (item.axis) {
        const reach = item.length / 2 + 0.35 * Math.max(item.length, 0.1);
        turned.add(line([[0, -reach, 0], [0, reach, 0]], { color: new Color("#ffffff"), opacity: 0.35 + 0.45 * sure }));
    }
    if (halo > 0) {
        const glow = { color: tint, transparent: true, opacity: 0.13, side: BackSide, depthWrite: false };
        turned.add(new Mesh(surface(item, halo * item.sigma.radius), new MeshBasicMaterial(glow)));
        const centre = new Mesh(new SphereGeometry(1, 20, 12), new MeshBasicMaterial({ ...glow, opacity: 0.45 }));
        centre.applyMatrix4(centreHalo(item.covariance, halo).setPosition(...item.center));
        group.add(centre);
    }
    group.add(turned);
    if (item.velocity && norm(item.velocity) > MOVES_SIGMAS * norm(item.sigma.velocity)) {
        group.add(arrow(item));
    }
    return group;
}

/** An arrow to the item's position in a moment. */
function arrow(item) {
    const group = new Group();
    const [from, way] = [new Vector3().fromArray(item.center), new Vector3().fromArray(item.velocity).multiplyScalar(ARROW_S)];
    const to = from.clone().add(way);
    const head = new Mesh(new ConeGeometry(0.018, 0.055, 14), new MeshBasicMaterial({ color: "#ffffff" }));
    head.position.copy(to);
    head.quaternion.setFromUnitVectors(UP, way.clone().normalize());
    group.add(line([from.toArray(), to.toArray()], { color: new Color("#ffffff"), opacity: 0.95 }), head);
    return group;
}

/** The path of a track, paler with age. */
export function trail(points, item) {
    const [way, tint] = [line(points, { vertexColors: true }), colour(item)];
    const colours = points.flatMap((_, index) => [tint.r, tint.g, tint.b, (index + 1) / points.length]);
    way.geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 4));
    return way;
}

/** The camera's field of view up to `depth`: the rays through the corners of its image, and its axes in red, green and blue. */
export function frustum({ width, height, fx, fy, cx, cy }, depth) {
    const corner = (u, v) => [((u - cx) / fx) * depth, ((v - cy) / fy) * depth, depth];
    const corners = [corner(-0.5, -0.5), corner(width - 0.5, -0.5), corner(width - 0.5, height - 0.5), corner(-0.5, height - 0.5)];
    const segments = corners.flatMap((from, index) => [[0, 0, 0], from, from, corners[(index + 1) % 4]]);
    const group = new Group();
    group.add(line(segments, { color: new Color("#c6d0e2"), opacity: 0.75 }, LineSegments));
    const length = depth * 0.6;
    [["#ff5f57", [length, 0, 0]], ["#4fd18b", [0, length, 0]], ["#5aafff", [0, 0, length]]].forEach(([tint, to]) => {
        group.add(line([[0, 0, 0], to], { color: new Color(tint), opacity: 1 }));
    });
    return group;
}

/** Frees the resources of a drawing. */
export function dispose(object) {
    object.traverse((part) => {
        part.geometry?.dispose();
        part.material?.dispose();
    });
}
