"""Bytes on a wire to blocks of SI samples, behind one interface (`drivers.base`)."""
