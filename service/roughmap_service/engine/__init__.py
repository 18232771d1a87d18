"""The one writer: the thread that numbers inputs, decides clouds and changes the map; recovery before it starts."""
