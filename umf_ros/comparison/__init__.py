"""Whether two views show the same place: pairs of scans, images or frames of recordings, each on its own."""
