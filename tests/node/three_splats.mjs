// Loads a .glb of splats with three.js's KHR_gaussian_splatting loader and prints centres and covariances as JSON.
// Arguments: folder of node_modules, file.
import fs from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [folder, file] = process.argv.slice(2);
const three = path.join(path.dirname(createRequire(folder + "/").resolve("three")), "..");
const load = (name) => import(pathToFileURL(path.join(three, name)));
const { GLTFLoader } = await load("examples/jsm/loaders/GLTFLoader.js");
const { GLTFGaussianSplatLoaderExtension: Extension } = await load(
  "examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js",
);

globalThis.self = globalThis;
const loader = new GLTFLoader().register((parser) => new Extension(parser));
const bytes = fs.readFileSync(file);
const { scene } = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");
let splats;
scene.traverse((object) => (splats = object.isGaussianSplat ? object : splats));
const attributes = Object.entries(splats.splatGeometry.attributes);
console.log(JSON.stringify(Object.fromEntries(attributes.map(([name, one]) => [name, Array.from(one.array)]))));
