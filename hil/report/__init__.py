"""What a run did, for people: one page that works offline, or one picture, from one log or several."""
