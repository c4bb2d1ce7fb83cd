"""What all other packages use: double precision, compilation, checks of arguments, small linear systems."""
