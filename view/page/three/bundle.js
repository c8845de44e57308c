export {
    BufferAttribute, BufferGeometry, CanvasTexture, Color, ConeGeometry, CylinderGeometry, DataTexture, DoubleSide, DynamicDrawUsage,
    EdgesGeometry, Float32BufferAttribute, GLSL3, GridHelper, Group, HemisphereLight, DirectionalLight, Line, LineBasicMaterial,
    LineDashedMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Points, Quaternion,
    RGBAFormat, Scene, ShaderMaterial, SphereGeometry, Sprite, SpriteMaterial, SRGBColorSpace, Vector3, WebGLRenderer, BackSide, FrontSide,
    AdditiveBlending, REVISION,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
