"""Check a bench (`acquire bench check`) and switch it off (`acquire bench off`)."""
