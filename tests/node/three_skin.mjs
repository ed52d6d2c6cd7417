// Loads a rigged .glb with three.js, poses it and prints what three.js makes of it, as JSON.
// Arguments: folder of node_modules, file, JSON of {bones: {name: [x, y, z, w]}, morphs: {name: weight}}.
import fs from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [folder, file, asked] = process.argv.slice(2);
const three = path.join(path.dirname(createRequire(folder + "/").resolve("three")), "..");
const load = (name) => import(pathToFileURL(path.join(three, name)));
const THREE = await load("build/three.module.js");
const { GLTFLoader } = await load("examples/jsm/loaders/GLTFLoader.js");

globalThis.self = globalThis;
const loader = new GLTFLoader();
loader.register(() => ({ name: "without pictures", loadTexture: async () => new THREE.Texture() }));
const bytes = fs.readFileSync(file);
const { scene } = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");

let mesh;
scene.traverse((object) => (mesh = object.isSkinnedMesh ? object : mesh));
const { bones, morphs } = JSON.parse(asked);
for (const [name, turn] of Object.entries(bones)) scene.getObjectByName(name).quaternion.fromArray(turn);
for (const [name, weight] of Object.entries(morphs)) {
  mesh.morphTargetInfluences[mesh.morphTargetDictionary[name]] = weight;
}
scene.updateMatrixWorld(true);
const point = new THREE.Vector3();
const vertices = [];
for (let row = 0; row < mesh.geometry.attributes.position.count; row++) {
  vertices.push(...mesh.getVertexPosition(row, point).toArray());
}
console.log(
  JSON.stringify({
    vertices,
    bones: mesh.skeleton.bones.map((bone) => bone.name),
    morphs: Object.keys(mesh.morphTargetDictionary),
    textured: mesh.material.map !== null,
  }),
);
