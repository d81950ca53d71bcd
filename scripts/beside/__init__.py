"""Parts of peers.py: each peer as it is called, the questions, and the page that is made of the answers."""
