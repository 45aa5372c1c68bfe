"""The viewer in the browser: where a camera sees enough, what it sees there, and why a view is good."""
