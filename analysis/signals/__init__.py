"""Records to signals: filtered, differentiated, with the linkage's geometry; which locks hold."""
