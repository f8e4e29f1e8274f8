pub(super) const NO_ADAPTER: &str = "install a Vulkan driver for your card, or the software one \
    (Debian and Ubuntu: apt-get install mesa-vulkan-drivers)";
