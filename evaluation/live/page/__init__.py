"""The live page: HTML, CSS and JavaScript, which need nothing from the network."""
