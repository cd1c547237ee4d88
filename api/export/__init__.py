"""Records as files that `stimrig.read` reads again: `stimrig export` of many, `stimrig.save` of one."""
