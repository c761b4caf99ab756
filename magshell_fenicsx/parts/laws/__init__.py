"""The laws of a shell's material: a file each, with its keys and its energy."""
