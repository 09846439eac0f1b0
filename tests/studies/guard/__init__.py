"""The guard on every shipped rig, protocol and effect: what is called an alarm and is none."""
