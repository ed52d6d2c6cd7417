// Prints the Khronos validator's report of a .glb as JSON. Arguments: folder of node_modules, file.
import fs from "node:fs";
import { createRequire } from "node:module";

const [folder, file] = process.argv.slice(2);
const validator = createRequire(folder + "/")("gltf-validator");
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)));
console.log(JSON.stringify(report.issues));
