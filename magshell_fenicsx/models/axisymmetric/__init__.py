"""The shell of revolution on its meridian, and the circumferential waves that this excludes."""
