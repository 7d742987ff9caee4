"""Effects that the nominal twin leaves out, one file each."""
