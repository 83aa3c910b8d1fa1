"""Configuration files of the programs; `ls conf/GROUP` lists what may be written for a group."""
