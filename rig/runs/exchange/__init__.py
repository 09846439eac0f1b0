"""Records of other programs in, records to other programs out."""
