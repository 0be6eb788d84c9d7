"""Numbers only: anatomy, scans, mechanics, fitting and the rig."""

import os

# Read when the first kernel starts its threads. Else these wait busily for the next kernel, which
# takes a tenth of the speed from what runs meanwhile and half of the processor from other workers.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
