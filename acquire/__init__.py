"""One sweep: protocol → plan → run → run file; quality; safety; the command line."""
