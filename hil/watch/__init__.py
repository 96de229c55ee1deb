"""Looking at a run from outside: its rings are read, the loop neither waits for a viewer nor knows of one."""
