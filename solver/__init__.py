"""Numbers only: anatomy, scans, mechanics, fitting and the rig."""
