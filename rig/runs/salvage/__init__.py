"""A damaged journal: found as such, read as far as it can be, rebuilt beside itself."""
