"""The bench: its vocabulary (`rig.model`), its services (`rig.services`) and its faces."""
