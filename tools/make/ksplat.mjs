// Writes a .ksplat with GaussianSplats3D: node ksplat.mjs IN.ply OUT.ksplat LEVEL DEGREE BLOCK_SIZE BUCKET_SIZE
// Run where npm has installed @mkkellogg/gaussian-splats-3d and three.
import * as fs from "fs";
import * as path from "path";
import { pathToFileURL } from "url";

const load = async (name, file) =>
    import(pathToFileURL(path.join(process.cwd(), "node_modules", name, file)).href);
const GS = await load("@mkkellogg/gaussian-splats-3d", "build/gaussian-splats-3d.module.js");
const THREE = await load("three", "build/three.module.js");

const [, , input, output, level, degree, block, bucket] = process.argv;
const bytes = fs.readFileSync(input);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const splats = GS.PlyParser.parseToUncompressedSplatArray(buffer, Number(degree));
const generator = GS.SplatBufferGenerator.getStandardGenerator(
    1, Number(level), 0, new THREE.Vector3(), Number(block), Number(bucket));
fs.writeFileSync(output, Buffer.from(generator.generateFromUncompressedSplatArray(splats).bufferData));
