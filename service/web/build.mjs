// Bundles src/ into dist/: scripts and stylesheets with content hashes in their names, and a gzip copy of each file.
// The HTML files keep their names; they are the only files that a browser has to revalidate.

import { build } from "esbuild";
import { mkdir, readFile, readdir, rename, rm, writeFile } from "node:fs/promises";
import { basename, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const here = fileURLToPath(new URL(".", import.meta.url));
const next = join(here, "dist.next");
const final = join(here, "dist");

await rm(next, { recursive: true, force: true });
await mkdir(next, { recursive: true });

const entries = ["src/main.ts", "src/reference.ts", "src/page.css", "src/icon.svg"];
const bundled = await build({
  absWorkingDir: here,
  entryPoints: entries,
  entryNames: "[name]-[hash]",
  chunkNames: "[name]-[hash]",
  // The viewer with three.js is a separate chunk: the page is usable before it is loaded.
  splitting: true,
  outdir: next,
  loader: { ".svg": "copy" },
  bundle: true,
  minify: true,
  format: "esm",
  target: ["es2022"],
  // three.js is under the MIT licence; its licence comment stays in the bundle.
  legalComments: "inline",
  metafile: true,
  logLevel: "warning",
});

// The viewer for saved pages: one classic script, because a page opened from disk cannot load modules.
const alone = await build({
  absWorkingDir: here,
  entryPoints: ["src/standalone.ts"],
  entryNames: "[name]-[hash]",
  outdir: next,
  bundle: true,
  minify: true,
  format: "iife",
  target: ["es2022"],
  legalComments: "inline",
  metafile: true,
  logLevel: "warning",
});
entries.push("src/standalone.ts");

const produced = {};
for (const [path, output] of Object.entries({ ...bundled.metafile.outputs, ...alone.metafile.outputs })) {
  if (!entries.includes(output.entryPoint)) continue;
  produced[basename(output.entryPoint)] = basename(path);
  // A script that imports a stylesheet has a second output beside it.
  if (output.cssBundle) produced[basename(output.entryPoint).replace(/\.ts$/, ".css")] = basename(output.cssBundle);
}

for (const document of ["index.html", "docs.html", "guide.html"]) {
  const html = await readFile(join(here, "src", document), "utf8");
  const linked = html.replace(/"page\/([^"]+)"/g, (_, source) => {
    if (!(source in produced)) throw new Error(`src/${document} mentions page/${source}, which is not bundled`);
    return `"page/${produced[source]}"`;
  });
  await writeFile(join(next, document), linked);
}

for (const name of await readdir(next)) {
  const packed = gzipSync(await readFile(join(next, name)), { level: 9 });
  await writeFile(join(next, `${name}.gz`), packed);
}

// The finished folder is moved into place: a service that reads dist/ never sees a partial build.
await rm(final, { recursive: true, force: true });
await rename(next, final);
