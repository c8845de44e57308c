//! Sets the name (soname) of the shared library, by which linked programs find it. Below version 1 each minor version has its own
//! layouts, and so its own name.

fn main() {
    let version = env!("CARGO_PKG_VERSION_MAJOR").to_owned() + "." + env!("CARGO_PKG_VERSION_MINOR");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libconicflow.so.{version}");
    println!("cargo::rerun-if-changed=build.rs");
}
