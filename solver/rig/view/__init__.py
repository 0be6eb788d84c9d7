"""Files of a rig that a browser reads: ``view.bin``, ``inside.bin`` and their container."""
