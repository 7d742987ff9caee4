"""Run files: layout, writer, reader, checksums, packing, documents."""
