"""Effects that the nominal parameters leaves out, one file each."""
