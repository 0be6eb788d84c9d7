"""The demonstration: one person's scans in over HTTP, a fitted rig and a report out."""
