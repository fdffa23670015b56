// The contents of a chosen file, read in the browser before anything is sent: names, shapes and types of its arrays.

export interface Entry {
  name: string;
  shape: number[];
  dtype: string;
}

const LOCAL = 0x04034b50;
const CENTRAL = 0x02014b50;
const END = 0x06054b50;

/** Return true for errors of a file that is truncated or not in the format of its name: the service will report them. */
export function unreadable(error: unknown): boolean {
  return error instanceof DOMException || error instanceof RangeError || error instanceof TypeError;
}

/** Return false for a folder, which is dropped like a file but has no contents to read. */
export async function isReadable(file: File): Promise<boolean> {
  return file.slice(0, 1).arrayBuffer().then(
    () => true,
    () => false,
  );
}

/** Return the arrays of an .npy or .npz file, or an empty list for any other file. Malformed files do not throw. */
export async function peek(file: File): Promise<Entry[]> {
  try {
    const head = new Uint8Array(await file.slice(0, 4).arrayBuffer());
    if (head[0] === 0x93) {
      const entry = header(new Uint8Array(await file.slice(0, 65536).arrayBuffer()));
      return entry ? [{ ...entry, name: "" }] : [];
    }
    if (new DataView(head.buffer).getUint32(0, true) === LOCAL) return await members(file);
  } catch (error) {
    if (!unreadable(error)) throw error;
  }
  return [];
}

async function members(file: File): Promise<Entry[]> {
  const found: Entry[] = [];
  for (const { name, offset, method } of await listing(file, 16)) {
    const entry = await member(file, offset, method);
    if (entry) found.push({ ...entry, name: name.replace(/\.npy$/, "") });
  }
  return found;
}

/** Location of a member in a zip file. */
export interface Member {
  name: string;
  offset: number;
  method: number;
  /** Compressed size in bytes. */
  packed: number;
}

/** Return the first members of a zip file, in the order of its directory. */
export async function listing(file: File, most = 10_000): Promise<Member[]> {
  const tail = new DataView(await file.slice(Math.max(0, file.size - 66000)).arrayBuffer());
  let end = tail.byteLength - 22;
  while (end >= 0 && tail.getUint32(end, true) !== END) end -= 1;
  if (end < 0) return [];
  const from = tail.getUint32(end + 16, true);
  const directory = new DataView(await file.slice(from, from + tail.getUint32(end + 12, true)).arrayBuffer());
  const found: Member[] = [];
  let at = 0;
  while (at + 46 <= directory.byteLength && directory.getUint32(at, true) === CENTRAL && found.length < most) {
    const nameLength = directory.getUint16(at + 28, true);
    const name = new TextDecoder().decode(new Uint8Array(directory.buffer, at + 46, nameLength));
    const [method, packed] = [directory.getUint16(at + 10, true), directory.getUint32(at + 20, true)];
    found.push({ name, offset: directory.getUint32(at + 42, true), method, packed });
    at += 46 + nameLength + directory.getUint16(at + 30, true) + directory.getUint16(at + 32, true);
  }
  return found;
}

/** Return a member's content, or null if the browser cannot decompress it. */
export async function unpacked(file: File, { offset, method, packed }: Member, type: string): Promise<Blob | null> {
  const start = await contentOf(file, offset);
  const content = file.slice(start, start + packed, type);
  if (method === 0) return content;
  if (method !== 8) return null;
  const stream = content.stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Blob([await new Response(stream).arrayBuffer()], { type });
}

/** Return the offset of a member's content, after its local header. */
async function contentOf(file: File, offset: number): Promise<number> {
  const local = new DataView(await file.slice(offset, offset + 30).arrayBuffer());
  return offset + 30 + local.getUint16(26, true) + local.getUint16(28, true);
}

async function member(file: File, offset: number, method: number): Promise<Omit<Entry, "name"> | null> {
  const start = await contentOf(file, offset);
  const packed = file.slice(start, start + 16384);
  if (method === 0) return header(new Uint8Array(await packed.arrayBuffer()));
  if (method !== 8) return null;
  const reader = packed.stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  let got = new Uint8Array(0);
  try {
    while (got.length < 10 || got.length < 10 + new DataView(got.buffer).getUint16(8, true)) {
      const { done, value } = await reader.read();
      if (done) break;
      const longer = new Uint8Array(got.length + value.length);
      longer.set(got);
      longer.set(value, got.length);
      got = longer;
    }
  } finally {
    // Only the start of the member was read, which the decompressor may report as an error.
    reader.cancel().catch(() => undefined);
  }
  return header(got);
}

function header(start: Uint8Array): Omit<Entry, "name"> | null {
  if (start[0] !== 0x93 || start.length < 12) return null;
  const view = new DataView(start.buffer, start.byteOffset);
  const [length, from] = start[6] === 1 ? [view.getUint16(8, true), 10] : [view.getUint32(8, true), 12];
  const text = new TextDecoder("latin1").decode(start.subarray(from, from + length));
  const dtype = /'descr':\s*'([^']+)'/.exec(text)?.[1];
  const shape = /'shape':\s*\(([^)]*)\)/.exec(text)?.[1];
  if (dtype === undefined || shape === undefined) return null;
  return { dtype: typeName(dtype), shape: shape.split(",").filter((part) => part.trim()).map(Number) };
}

function typeName(descr: string): string {
  const kinds: Record<string, string> = { f: "float", i: "int", u: "uint", b: "bool", c: "complex" };
  const kind = kinds[descr.charAt(1)];
  if (kind === undefined) return descr;
  return kind === "bool" ? kind : kind + 8 * Number(descr.slice(2));
}

/** Format entries as "tracks 60 × 2400 × 2 float32". */
export function describe(entries: Entry[]): string {
  return entries
    .map((entry) => [entry.name, entry.shape.join(" × ") || "one value", entry.dtype].filter(Boolean).join(" "))
    .join(", ");
}
