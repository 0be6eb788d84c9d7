"""What a browser reads of a rig: ``view.bin``, ``inside.bin`` and their container."""
