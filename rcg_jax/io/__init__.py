"""Files and streams: atomic writes, digests, starts files, consoles."""
