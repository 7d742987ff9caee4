"""Many runs in one process, and several processes at once."""
