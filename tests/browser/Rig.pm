# tests/browser/Rig.pm - rigsim's cameras and a rigd with a page, in a folder of their own.
package Rig;
use strict;
use warnings;
use Cwd ();
use File::Temp ();
use IO::Socket::INET;
use Time::HiRes qw(time sleep);

sub new {
    my ($class, $n_cameras) = @_;
    my $bin = $ENV{BIN} // 'build/bin';
    my $dir = File::Temp::tempdir('studiorig-test-XXXXXX', TMPDIR => 1, CLEANUP => 1);
    my $listener = IO::Socket::INET->new(Listen => 1, LocalAddr => '127.0.0.1') or die "no free port: $!";
    my $self = bless { bin => $bin, dir => $dir, n => $n_cameras, port => $listener->sockport, wires => "$dir/w" }, $class;
    close $listener;
    my $first = $n_cameras < 10 ? 20000 + $$ % 2000 * 20 : 10000 + $$ % 20 * 450; # as tests/test_rig_chain.sh; or out of its way
    my @sim = ("$bin/rigsim", '--cameras', $n_cameras, qw(--personality nikon --seed 1 --raw-size 408x272 --port), $first, '--trigger-socket', $self->{wires});
    $self->{list} = `@sim --list`;
    $self->{sim} = run("$dir/sim.log", @sim);
    for (1 .. 100) { last if -S $self->{wires}; sleep .05 }
    return $self;
}

sub run {
    my ($log, @command) = @_;
    my $pid = fork // die "fork: $!";
    return $pid if $pid;
    open STDOUT, '>>', $log;
    open STDERR, '>&', \*STDOUT;
    exec @command or die "$command[0]: $!";
}

sub url { "http://127.0.0.1:$_[0]{port}/" }

sub start { # wires: where its trigger is looked for
    my ($self, $wires) = @_;
    my ($dir, $list) = ($self->{dir}, $self->{list});
    $list =~ s/^address = .*/address = $wires/m if $wires;
    open my $f, '>', "$dir/rigd.conf" or die $!;
    print $f "[rig]\nname = studio <b>one</b>\ntakes = $dir/takes\nstate = $dir/state\nsocket = $dir/s\npersonality_dir = ", Cwd::getcwd(), "/config/cameras\nraw_mb = 2\nfree_space_mb = 1\n",
        "[web]\nlisten = 127.0.0.1:$self->{port}\n[settings]\niso = 100\nshutter = 1/125\n", $list;
    close $f;
    $self->{rigd} = run("$dir/rigd.log", "$self->{bin}/rigd", '--config', "$dir/rigd.conf");
}

sub stop { # how long it took, in seconds
    my ($self, $signal) = @_;
    my $began = time;
    return 0 unless $self->{rigd};
    kill $signal // 'TERM', $self->{rigd};
    waitpid delete $self->{rigd}, 0;
    return time - $began;
}

sub DESTROY {
    my ($self) = @_;
    local $?;
    $self->stop;
    kill 'TERM', $self->{sim};
    waitpid $self->{sim}, 0;
}
1;
